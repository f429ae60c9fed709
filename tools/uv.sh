#!/usr/bin/env bash
# Runs uv: the one on PATH, else a private copy that is installed into .tools on first use.
set -euo pipefail
if command -v uv >/dev/null 2>&1; then
    exec uv "$@"
fi
private=.tools/uv
if [ ! -x "$private/bin/uv" ]; then
    python=
    for candidate in python3 python3.13 python3.12 python3.11 python3.10 python3.9 python3.8 python; do
        if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 8))' >/dev/null 2>&1; then
            python=$candidate
            break
        fi
    done
    if [ -z "$python" ]; then
        echo "error: no Python 3.8 or newer on PATH to install uv with; install one, or install uv itself" >&2
        exit 1
    fi
    echo "uv is not on PATH: installing a private copy into $private"
    rm -rf "$private"
    # A virtual environment needs ensurepip, which Debian packages apart; pip alone serves as well.
    if "$python" -m venv "$private" >/dev/null 2>&1; then
        "$private/bin/python" -m pip install --quiet "uv==$UV_VERSION"
    else
        rm -rf "$private"
        "$python" -m pip install --quiet --prefix "$private" --ignore-installed "uv==$UV_VERSION"
    fi
fi
exec "$private/bin/uv" "$@"
