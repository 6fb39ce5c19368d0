# Everything a fresh machine needs: `make demo` and `make test` install what is missing into .venv first.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
READY := .venv/.ready
DOCS := .venv/.docs

# Some machines' setting: hundreds of processes of the tests would each compile every module again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install demo size test test-browser test-slow fuzz faults determinism calibration style types suite lint format bench bench-gpu docs release-check

install: $(READY)

$(READY): pyproject.toml constraints.txt
	@echo "installing into .venv: some 1.7 GB, a minute or two, the first time only"
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --progress-bar off --disable-pip-version-check -c constraints.txt -e ".[dev]"
	touch $(READY)

demo: $(READY)
	$(BIN)/mrac-jax evaluate example:terrain --rollouts 20000 --deadline 400 --out out/demo
	@echo "Open the page, one file with everything in it: $(CURDIR)/out/demo/index.html"

test: style size
	$(MAKE) --no-print-directory -j 2 types suite

suite: $(READY)
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not slow"

# Pages and the studio in the system's Chromium (Debian: apt install chromium chromium-driver), part of make test too.
test-browser: $(READY)
	$(BIN)/python -m pytest -m "browser and not slow"

# make test-slow PART=3/8 runs the third of eight parts; the results go to tests/evidence.json.
PART ?= 1/1
test-slow: $(READY)
	$(BIN)/python tests/evidence.py --part $(PART)

# Damaged and hostile inputs: make fuzz COUNT=100000 FIRST=20000 goes on where another run ended.
COUNT ?= 20000
FIRST ?= 0
fuzz: $(READY)
	$(BIN)/python tests/fuzz.py --count $(COUNT) --first $(FIRST)

# Kills, full disks, second writers, flipped bits (an hour or more); random settings run in every way.
KILLS ?= 300
faults: $(READY)
	$(BIN)/python tests/faults.py --kills $(KILLS)

determinism: $(READY)
	$(BIN)/python tests/determinism.py

# How often printed intervals hold the truth, on ten small worlds: some ten minutes.
SEEDS ?= 500
calibration: $(READY)
	$(BIN)/python tests/calibration.py --seeds $(SEEDS)

lint: style types size

# Code lines and files, below the ceiling in tests/size.json.
size: $(READY)
	$(BIN)/python tests/size.py

style: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: $(READY)
	$(BIN)/mypy

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(READY)
	$(BIN)/python tests/bench.py plans
	$(BIN)/python tests/bench.py

bench-gpu: $(READY)
	$(BIN)/python -m mrac_jax.bench

docs: $(DOCS)
	$(BIN)/sphinx-build --quiet --fail-on-warning --keep-going --fresh-env --write-all docs out/site
	$(BIN)/python -m pytest tests/test_site.py
	@echo "Open the site: $(CURDIR)/out/site/index.html"

$(DOCS): $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[docs]"
	touch $(DOCS)

release-check:
	PYTHON=$(PYTHON) .ci/release-check.sh
