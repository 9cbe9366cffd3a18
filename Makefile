# Two commands: `make statistics` and `make test`. Both set up .venv with the pinned versions first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
CORES ?= 2

.PHONY: statistics examples test full untuned noise lint format environment clean

statistics: environment
	$(BIN)/snakemake --cores $(CORES) statistics

examples: environment
	$(BIN)/snakemake --cores $(CORES) examples

test: environment lint
	$(BIN)/pytest --numprocesses logical --dist loadgroup --no-loadscope-reorder

# Full-size checks, minutes each and no part of `make test`.
full: environment
	$(BIN)/pytest --numprocesses logical --dist loadgroup --no-loadscope-reorder -m "slow or not slow" --ignore=tests/slow

untuned: environment
	$(BIN)/pytest -m slow -s tests/slow/test_untuned_systems.py

noise: environment
	$(BIN)/pytest -m slow -s tests/slow/test_noise_statistics.py

lint: environment
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/snakefmt --check Snakefile workflow
	$(BIN)/snakemake --lint

format: environment
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/snakefmt Snakefile workflow

environment: $(VENV)/installed

# The stamp is written last: an interrupted installation is begun again.
$(VENV)/installed: pyproject.toml requirements/pinned.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "siq needs Python 3.11 or newer; name one with 'make PYTHON=python3.12 ...'." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint requirements/pinned.txt --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) .snakemake .mypy_cache .ruff_cache .pytest_cache
