# make train   install everything and train E2C-MAPPO (T) on the multi-rover task
# make test    install everything and run the tests
# make torture kill, starve, fuzz and deceive it, and print what survived (4 minutes)
# make soak    train for MINUTES, and see whether memory, handles or files grow
# Every other target installs first, too; a second call installs nothing.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
SOURCES := sb3_e2c/*.py envs zoo tests

.PHONY: train test pytest torture soak format lint type check-codestyle commit-checks clean

train: $(INSTALLED)
	$(BIN)/python -m sb3_e2c.zoo.demo

test pytest: $(INSTALLED)
	$(BIN)/python -m pytest -n 2

torture: $(INSTALLED)
	PYTHONPATH=tests timeout 600 $(BIN)/python -m torture

MINUTES ?= 120
soak: $(INSTALLED)
	PYTHONPATH=tests $(BIN)/python -m torture.soak --minutes $(MINUTES) -o soak

format: $(INSTALLED)
	$(BIN)/ruff check --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

lint check-codestyle: $(INSTALLED)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)

type: $(INSTALLED)
	$(BIN)/mypy

commit-checks: format type lint

$(INSTALLED): setup.cfg pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	-$(BIN)/python -m pip install --quiet --timeout 15 --retries 1 "pip >= 24.2, < 26"  # older: search for ever without pins; newer: not quiet
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[tests]"
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info
