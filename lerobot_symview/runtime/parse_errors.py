"""Errors of a command line in plain words: which flag, what was given, what is expected.

draccus and argparse report them with Python types, once for each alternative of a union and level of a configuration.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator

from lerobot_symview.errors import OptionError

KINDS = {"an int": "an integer", "a float": "a number", "a bool": "true or false"}
NUMBERS = {"int": "integers", "float": "numbers", "str": "names"}
VALUE = re.compile(r"(?:convert|parse) '([^']*)'|value='([^']*)'|value=(\S+) ")


def unknown_flags(argparse_output: str) -> str:
    """Return argparse's error; of unknown flags, with the known ones that are closest.

    Args:
        argparse_output: the usage, which lists the known flags, and the error.
    """
    usage, _, reason = argparse_output.strip().rpartition("error: ")
    if found := re.fullmatch(r"argument (\S+): expected one argument", reason):
        return f"{found[1]} needs a value: write {found[1]}=value"
    given = reason.removeprefix("unrecognized arguments: ")
    if given == reason:
        return reason
    known = re.findall(r"\[(--[\w.]+)", usage)
    return "; ".join(_unknown(argument, known) for argument in given.split() if argument.startswith("-")) or reason


def reason(error: BaseException) -> str:
    """Return what is wrong with a value, from an error of draccus and its causes."""
    chain = list(_chain(error))
    for one in chain:
        if isinstance(one, OptionError):  # of our own: it names what was got and expected
            return f"{_flag(_path(chain))}: {one}" if _path(chain) else str(one)
    return _plain(chain) or _joined(chain)


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__


def _path(chain: Iterable[BaseException]) -> tuple[str, ...]:
    """Return the longest path of field names in a chain of errors."""
    return max((tuple(map(str, getattr(error, "key_path", ()))) for error in chain), key=len)


def _plain(chain: list[BaseException]) -> str | None:
    """Return the reason in plain words; None for an error of another kind."""
    text, path = "\n".join(map(str, chain)), _path(chain)
    if found := re.search(r"Missing required field\(s\) (.*) for ", text):
        return "; ".join(f"{_flag([*path, name])} is missing" for name in re.findall(r"`(\w+)`", found[1]))
    if found := re.search(r"The fields? (.*) (?:is|are) not valid for", text):
        return "; ".join(f"unknown flag {_flag([*path, name])}" for name in re.findall(r"`(\w+)`", found[1]))
    if found := re.search(r"Expected (\d+) items, got (\d+)", text):
        return f"{_flag(path)} must have {found[1]} entries, got {found[2]}"
    value = next((group for match in VALUE.finditer(text) for group in match.groups() if group is not None), None)
    if value is None:
        return None
    choices = list(dict.fromkeys(re.findall(r"[\w.]+", ", ".join(re.findall(r"into one of: (.*)", text)))))
    expected = [f"one of {', '.join(choices)}"] if choices else []
    expected += [words for kind, words in KINDS.items() if re.search(rf"into {kind}\b", text)]
    for kind, items in dict.fromkeys(re.findall(r"of type (list|tuple)\[(.*)\]", text)):
        expected.append(_list(kind, items))
    if not expected:
        return None
    guess = difflib.get_close_matches(value, choices, n=1)
    hint = f"; did you mean {guess[0]!r}?" if guess else ""
    return f"{_flag(path)} must be {' or '.join(expected)}, got {value!r}{hint}"


def _flag(path: Iterable[str]) -> str:
    """Return the flag of a field, such as `--workspace.center`; of an entry of a list, `--workspace.center[1]`."""
    return "--" + re.sub(r"\.(\d+)", r"[\1]", ".".join(path))


def _list(kind: str, items: str) -> str:
    """Return `a list of 2 numbers, such as [1, 2]` for `tuple` and `float, float`."""
    types = [item.strip() for item in items.split(",") if item.strip() != "..."]
    words = NUMBERS.get(types[0], "entries")
    count = f"{len(types)} " if kind == "tuple" and "..." not in items else ""
    entries = (f"name{index}" if words == "names" else str(index) for index in range(1, max(len(types), 2) + 1))
    example = ", ".join(entries)
    return f"a list of {count}{words}, such as [{example}]"


def _joined(chain: list[BaseException]) -> str:
    """Return the messages of all errors: draccus names the field, the cause names the value."""
    messages = [str(chain[0])]
    messages += [str(error) for error in chain[1:] if str(error) not in messages[-1]]
    return ": ".join(message for message in messages if "Couldn't instantiate class" not in message)


def _unknown(argument: str, known: list[str]) -> str:
    flag = argument.partition("=")[0]
    guess = difflib.get_close_matches(flag, known, n=1, cutoff=0.7)
    return f"unknown flag {flag}" + (f"; did you mean {guess[0]}?" if guess else "")
