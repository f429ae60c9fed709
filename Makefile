# `make demo` and `make test` set everything up on a fresh Linux machine with any Python 3.8 or newer and a package index.
SHELL := /bin/bash
PYTHON := .venv/bin/python
READY := .venv/.ready
UV_VERSION := 0.13.9

.PHONY: demo test test-fast test-learning lint docs setup doctor pins clean

demo: $(READY) ## demonstrations, views, training, evaluation and a report in outputs/demo
	@.venv/bin/symview-demo $(ARGS)

test: $(READY) lint ## every test but those of test-learning, slow ones included
	OMP_NUM_THREADS=1 $(PYTHON) -m pytest --numprocesses=auto --dist=loadfile --no-loadscope-reorder -m "not learning" $(ARGS)

test-learning: $(READY) ## trainings that must reach 70 and 75 %: a quarter of an hour on one core
	OMP_NUM_THREADS=1 $(PYTHON) -m pytest -m learning $(ARGS)

test-fast: $(READY) lint ## the tests that take seconds: under 4 minutes on 2 cores
	OMP_NUM_THREADS=1 $(PYTHON) -m pytest --numprocesses=auto --dist=loadfile --no-loadscope-reorder -m "not slow and not long and not install and not learning" $(ARGS)

lint: $(READY)
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

docs: $(READY) ## the documentation, in outputs/site
	@.venv/bin/zensical build --strict

setup: $(READY) ## the environment alone, in .venv

doctor: $(READY) ## what is wrong with the environment, and the remedy
	@.venv/bin/symview-doctor

$(READY): pyproject.toml constraints.txt tools/uv.sh
	@echo "Setting up .venv: Python $$(cat .python-version), LeRobot, PyTorch (about 3 GB) and PyBullet."
	@echo "PyBullet has no wheel for this Python and is compiled once: 3 to 10 minutes. Later runs start in seconds."
	@UV_VERSION=$(UV_VERSION) tools/uv.sh venv --quiet --allow-existing .venv
	@UV_VERSION=$(UV_VERSION) tools/uv.sh pip install --python .venv --constraint constraints.txt --all-extras --requirement pyproject.toml --editable .
	@touch $(READY)

pins: ## resolve every requirement anew and write the versions into constraints.txt
	@UV_VERSION=$(UV_VERSION) $(PYTHON) tools/pins.py

clean: ## remove what the demo made
	rm -rf outputs/demo
