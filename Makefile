# All targets install what they need; see CONTRIBUTING.md.
#
# Without a GPU, an index of CPU-only torch wheels saves gigabytes:
#   make train TORCH_INDEX=...

VENV ?= .venv
PYTHON ?= python3
TORCH_INDEX ?=
ENV ?= LunarLander-v3
ARGS ?=

EXTRAS = board,box2d,doom,play,plot,secure,train

PIP_INSTALL = $(VENV)/bin/python -m pip install --disable-pip-version-check --quiet \
	--constraint constraints.txt $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))

.PHONY: train test test-slow test-browser test-compose lint format types docs bench chaos soak fuzz setup setup-dev clean

train: setup  ## Train LunarLander to a mean return of 200.
	$(VENV)/bin/udrl train $(ENV) --stop-return 200 $(ARGS)

# Tests start hundreds of processes: keep compiled modules even where the environment says not to.
test test-slow test-browser: export PYTHONDONTWRITEBYTECODE =

test: setup-dev  ## Run the tests, except the slow ones.
	$(VENV)/bin/python -m pytest -m "not slow and not compose and not browser" -n 4 $(ARGS)

test-slow: setup-dev  ## Run the slow tests.
	$(VENV)/bin/python -m pytest -m slow -n 4 $(ARGS)

test-browser: setup-dev  ## Test the board in Chromium; skipped if there is none.
	$(VENV)/bin/python -m pytest -m browser $(ARGS)

test-compose: setup-dev  ## Test the containers with Docker; skipped if there is no engine.
	$(VENV)/bin/python -m pytest -m compose $(ARGS)

lint: setup-dev  ## Run ruff (rules and format) and import-linter.
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/lint-imports

format: setup-dev  ## Format the code and fix what ruff can fix.
	$(VENV)/bin/ruff format .
	$(VENV)/bin/ruff check --fix .

types: setup-dev  ## Run mypy.
	$(VENV)/bin/mypy

docs: $(VENV)/.installed-docs  ## Build the documentation in build/site; broken links are errors.
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict $(ARGS)

bench: setup-dev  ## Measure speed (docs/performance.md).
	$(VENV)/bin/python benchmarks/speed.py $(ARGS)

chaos: setup-dev  ## Inject faults into real runs (docs/reliability.md).
	$(VENV)/bin/python benchmarks/chaos.py $(ARGS)

soak: setup-dev  ## Check a run of half an hour for growing memory (docs/reliability.md).
	$(VENV)/bin/python benchmarks/soak.py $(ARGS)

fuzz: setup-dev  ## Fuzz every decoder and queryable (SECURITY.md).
	$(PIP_INSTALL) --editable '.[$(EXTRAS),dev,fuzz]'
	$(VENV)/bin/python -m tests.fuzz coverage $(ARGS)
	$(VENV)/bin/python -m tests.fuzz hypothesis $(ARGS)

setup: $(VENV)/.installed
setup-dev: $(VENV)/.installed-dev

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: $(VENV)/bin/python pyproject.toml constraints.txt
	$(PIP_INSTALL) --editable '.[$(EXTRAS)]'
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(PIP_INSTALL) --editable '.[$(EXTRAS),hub,metrics,minari,mlflow,tensorboard,wandb,dev]'
	touch $@

$(VENV)/.installed-docs: $(VENV)/bin/python pyproject.toml constraints.txt
	$(PIP_INSTALL) --editable '.[docs]'
	touch $@

clean:
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -prune -exec rm -rf {} +
