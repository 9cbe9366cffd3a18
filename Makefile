# Two commands: `make statistics` and `make test`. Each target sets up .venv with the pinned versions first. What
# stands behind `##` is what `make help` says of a target; tests/test_release.py asks for it.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
CORES ?= 2
# Where torch comes from on Linux, whose usual build brings 3 GB for graphics cards along. `make TORCH_INDEX=`
# takes that one.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
# Bytecode is written when a module is first imported: that of all 15,000 would take longer than to unpack them.
INSTALL := $(BIN)/python -m pip install --quiet --no-compile
# It has to be written then: the imports of one process cost 12 s without any, 4 s with it, and there are hundreds.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help

.PHONY: help statistics examples test suite test-portable full untuned noise slurm wheel test-pages newcomer laboratories coverage supports discrepancies \
        hostile golden mutants speed official docs docs-full schemas release-check lint format environment clean

help:  ## this list, which plain `make` prints, too
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-14s %s\n", $$1, $$2}' $(firstword $(MAKEFILE_LIST))

statistics: environment  ## 50 runs of the paper's system, with their page: results/archetype3d/report.html
	$(BIN)/snakemake --cores $(CORES) statistics

examples: environment  ## the two examples that come with their recordings
	$(BIN)/snakemake --cores $(CORES) examples

test: lint suite  ## lint, and every test that takes seconds: what CI asks first

# Branches of the modules that decide are counted on the way, with a floor: pyproject.toml.
suite: environment  ## the tests of `make test` without lint, with the floor of coverage
	$(BIN)/pytest --numprocesses logical --dist loadgroup --no-loadscope-reorder --cov

# Quick numerical tests as on a processor without AVX-512: sums are rounded otherwise there, and no answer may hang on
# that. On a processor that has none there is nothing to switch off: `make suite` runs the same there.
WITHOUT_AVX512 := NPY_DISABLE_CPU_FEATURES="X86_V4 AVX512_ICL AVX512_SPR" OPENBLAS_CORETYPE=Haswell \
                  ATEN_CPU_CAPABILITY=avx2 NUMBA_CPU_NAME=haswell
test-portable: environment  ## quick numerical tests as on a processor without AVX-512
	! grep --quiet --no-messages --word-regexp avx512f /proc/cpuinfo || $(WITHOUT_AVX512) $(BIN)/pytest -m "portable and not slow" \
	  $$(grep --recursive --files-with-matches --include='*.py' mark.portable tests) \
	  --numprocesses logical --dist loadgroup --no-loadscope-reorder

# Everything: the tests of `make test` and the full-size checks, minutes each.
full: environment lint  ## every test, the full-size checks included: minutes each
	$(BIN)/pytest --numprocesses logical --dist loadgroup --no-loadscope-reorder -m "slow or not slow"

untuned: environment  ## systems for which nothing was tuned, with networks
	$(BIN)/pytest -m slow -s tests/slow/test_untuned_systems.py

noise: environment  ## statistics of the paper's system with noise, 50 runs
	$(BIN)/pytest -m slow -s tests/slow/test_noise_statistics.py

# Controller and two nodes on this machine, as root; see the docstring of the test for what has to be there.
slurm: environment  ## a study on a small Slurm of its own, of which a node dies
	$(INSTALL) --constraint requirements/pinned.txt --editable '.[dev,slurm]'
	$(BIN)/pytest -m slow -rs tests/slow/test_slurm.py

# The wheel, and a small problem solved with it where neither the sources nor an extra are at hand.
wheel: environment  ## the wheel in dist/, installed and used elsewhere without extras
	rm -rf build dist
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .
	PYTHON=$(BIN)/python .ci/check-wheel

# Every kind of page in Chromium, on a desk and on a phone; skipped where there is no Chromium.
test-pages: environment docs  ## every kind of page in Chromium, on a desk and on a phone
	$(BIN)/python -m pip install --quiet --constraint requirements/pinned.txt --editable '.[pages]'
	$(BIN)/pytest -m pages tests/pages

# A fresh environment, a wheel, recordings: how long until a certified barrier and until a verdict.
newcomer: wheel  ## how long a newcomer waits for a certified barrier, and for a verdict
	$(BIN)/python benchmarks/newcomer.py

# Noisy, hopping records of simulated laboratories, a hundred of each, against the Cramér–Rao bounds of their
# barriers and other methods: hours, and it goes on where it was stopped. `make laboratories SEEDS=5` for a look;
# SFI_PYTHON=... names a Python that has StochasticForceInference.
SEEDS ?= 100
laboratories: environment  ## simulated laboratories against their bounds and other methods: hours (SEEDS=5 for a look)
	$(BIN)/python -m benchmarks.laboratories --seeds $(SEEDS) --cores $(CORES)

# Whether standard errors cover at every ratio of sensor noise to random forces, and the intervals of what a
# user reads, in laboratories of all kinds.
coverage: environment  ## whether errors and intervals cover, in laboratories of all kinds
	$(BIN)/python -m benchmarks.laboratories.coverage --seeds 200 --cores $(CORES)
	$(BIN)/python -m benchmarks.laboratories.coverage --landscapes --seeds 200

# Whether f has the true terms, and no others, in records that hold the evidence.
supports: environment  ## whether f has the true terms, and no others
	$(BIN)/python -m benchmarks.laboratories.supports --seeds $(SEEDS) --cores $(CORES)

# The diagnosis beside other methods on forty concealed cases, 60 s a case and method on one core: about an hour, and
# it goes on where it was stopped.
discrepancies: environment  ## the diagnosis beside other methods on forty concealed cases: an hour
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 $(BIN)/python -m benchmarks.discrepancies

# Records of seventy kinds that nobody should certify, and honest ones that look alike: hours, and it goes on where it was
# stopped. `make hostile HOSTILE='--seeds 0'` for a look; a fifth of the kinds runs with HOSTILE=--held-out alone.
HOSTILE ?=
hostile: environment  ## records that nobody should certify, and honest ones that look alike: hours
	$(BIN)/python -m benchmarks.hostile --jobs $(CORES) $(HOSTILE)
	$(BIN)/python -m benchmarks.hostile --jobs $(CORES) $(HOSTILE) --honest

# What the code gives, against the tables in tests/golden: half an hour of one core. `make golden GROUP=equations` is one
# group, `GOLDEN=--write` writes the tables, `GOLDEN='--results DIR'` names another folder of results.
GROUP ?=
golden: environment  ## results against the tables in tests/golden: half an hour (GROUP=equations for a part)
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 $(BIN)/python -m benchmarks.golden $(GROUP) $(GOLDEN)

# The official tests of public benchmarks: results/official/page.md, a table with published figures, and a
# picture of each. Nothing is downloaded; `make official SIQ_RESOURCES=DIR` names the folder of their files.
official: environment  ## official tests of public benchmarks (SIQ_RESOURCES=DIR has their files)
	SIQ_RESOURCES=$(SIQ_RESOURCES) $(BIN)/snakemake --cores $(CORES) official

# docs/_build/html/index.html: the pages and the reference. A warning is an error.
docs: environment  ## the documentation: docs/_build/html/index.html; a warning is an error
	rm -rf docs/_build/html docs/api
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet -b html docs docs/_build/html

# The documentation from its beginnings: examples, notebooks and pictures are made anew, figures read from results.
docs-full: environment  ## examples, notebooks and pictures made anew, then the documentation
	$(BIN)/python docs/make/gallery.py
	$(BIN)/python docs/make/notebooks.py
	$(BIN)/python docs/make/concepts.py
	$(BIN)/python docs/make/inspection.py
	$(BIN)/python docs/make/figures.py
	$(MAKE) docs

# Faults put into the modules that decide, one at a time: do their tests see them? `make mutants MODULE=selection`.
MODULE ?=
MUTANTS ?= 20
mutants: environment  ## whether tests see faults in the modules that decide: hours (MODULE=selection MUTANTS=5)
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 $(BIN)/python -m benchmarks.mutation $(MODULE) --sample $(MUTANTS)

# Processor time of four things that people wait for, appended to benchmarks/speed.csv; a fifth more than before is an error.
speed: environment  ## what people wait for, timed and compared with earlier: three minutes
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 $(BIN)/python -m benchmarks.speed

# Schemas of configuration for editors and for the catalogue of workflows, from the classes that check it.
schemas: environment  ## workflow/schemas/, from the classes that check the configuration
	$(BIN)/python docs/make/schemas.py

# Version, changelog, citation, recipe, schemas, wheel and sdist, documentation, worktree. Nothing is published.
release-check: environment  ## the checklist before a release, walked by a machine; nothing is published
	$(BIN)/python .ci/release_check.py

lint: environment  ## ruff, mypy, snakefmt, and Snakemake's own lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/snakefmt --check Snakefile workflow
	$(BIN)/snakemake --lint

format: environment  ## the sources, formatted
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/snakefmt Snakefile workflow

environment: $(VENV)/installed  ## .venv with the pinned versions of everything; each target asks for it

# The stamp is written last: an interrupted installation is begun again.
$(VENV)/installed: pyproject.toml requirements/pinned.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "siq needs Python 3.11 or newer; name one with 'make PYTHON=python3.12 ...'." >&2; exit 1; }
	@echo "Installing siq with all of its tools below $(VENV): about 2.4 GB, 1 GB of it for networks (CPU only)."
	$(PYTHON) -m venv $(VENV)
	@test -z "$(TORCH_INDEX)" || test "$$(uname)" != Linux || $(INSTALL) --no-deps \
	  --retries 0 --timeout 15 --index-url $(TORCH_INDEX) --constraint requirements/pinned.txt torch 2> /dev/null \
	  || echo "$(TORCH_INDEX) does not answer; torch comes from the usual index."
	$(INSTALL) --constraint requirements/pinned.txt --editable '.[dev]'
	touch $@

clean:  ## removes .venv and what tools and builds have written, not results
	rm -rf $(VENV) .snakemake .mypy_cache .ruff_cache .pytest_cache build dist docs/_build docs/api
