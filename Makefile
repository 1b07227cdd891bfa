# One word each, the same locally and in CI: `make run`, `make test`, `make lint`, `make docs`, `make soak`, `make bench`,
# `make real`, `make mcu-test`, `make lock`, `make clean`.
VENV ?= .venv
PYTHON ?= python3
BIN := $(VENV)/bin
WALK := build/walk.mcap
REPEATS ?= 3
# `make test LOCKED=1`: the very versions of constraints.txt, with which all tests passed; otherwise the newest that fit.
LOCK := $(if $(LOCKED),--constraint constraints.txt)

# Flows are started by the hundred: each process would compile every module again where this is set.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run test lint lock docs compiled soak bench real mcu-test clean

# The environment is made once, and again when the project's needs change. A dot every two seconds says that it goes on.
define install
	@$(BIN)/pip install --quiet --disable-pip-version-check $(LOCK) --editable $(1) & installing=$$!; trap 'kill $$installing; exit 130' INT TERM; \
	while kill -0 $$installing 2>/dev/null; do printf .; sleep 2; done; echo; wait $$installing
	@touch $@
endef

# What it runs on: enough for `make run` and the page.
RUNS_ON := .[plot,view]
$(BIN)/.runs: pyproject.toml
	@$(PYTHON) -m venv $(VENV)
	@echo "installing what caneflow runs on: numpy, scipy, Zenoh, matplotlib ... (about a minute)"
	$(call install,'$(RUNS_ON)')

# And what tests, linters and pages need.
$(BIN)/.installed: $(BIN)/.runs pyproject.toml
	@echo "installing what tests, linters and pages need as well (about two minutes)"
	$(call install,'.[dev]')

$(WALK): | $(BIN)/.runs
	@mkdir -p $(dir $@)
	$(BIN)/caneflow simulate walk --seed 1 --output $@

run: $(BIN)/.runs $(WALK)
	$(BIN)/caneflow run dataflows/compare.yaml --replay $(WALK) --speed max --record build/track.mcap --overwrite
	$(BIN)/caneflow plot build/track.mcap --output build/track.png
	@echo
	@echo "six processes found the way of a simulated walk by two methods: best, and the paper's"
	@echo "build/track.png shows both tracks over the true one, their errors, the speed and the radar's Doppler"
	@echo "next: . $(BIN)/activate && caneflow run dataflow.yaml --replay $(WALK)    (or: caneflow --help)"

test: $(BIN)/.installed
	$(BIN)/pytest --numprocesses 3

lint: $(BIN)/.installed
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

# constraints.txt again: the newest versions that fit, to be committed once all tests pass with them.
lock: $(BIN)/.installed
	$(BIN)/pip install --quiet --dry-run --ignore-installed --report - --editable '.[dev]' | $(BIN)/python .ci/lock.py > constraints.txt

# What the pages say of messages, commands and settings is written from the code; the site is build/site/index.html.
docs: $(BIN)/.installed
	$(BIN)/python -m caneflow.messages.reference docs
	$(BIN)/python -m caneflow.runtime.dataflow.yaml_reference docs
	$(BIN)/sphinx-build --fail-on-warning --quiet docs build/site

# The tests compiled once, for `.ci/run` beside the linters: on a clean clone each worker of `make test` would do it. What
# cannot be compiled, `make test` says.
compiled: $(BIN)/.installed
	-@$(BIN)/pytest --collect-only --quiet >/dev/null

# The long tests: every shared walk at real time and at full speed, calm and under load; kills, freezes, networks; fuzzing
# with CANEFLOW_FUZZ_TIMES=100 times as many examples as in CI, CANEFLOW_SOAK_MINUTES of random kills. Property tests, the
# short ones as well, draw other examples each time.
soak: export CANEFLOW_EXAMPLES = others
soak: $(BIN)/.installed
	$(BIN)/pytest -m long
	$(BIN)/pytest --numprocesses 2 $$(grep --files-with-matches "@given" tests/test_*.py)

# The firmware: built, measured, booted in an emulator and compared with the model; docs/mcu.md says what that needs.
mcu-test: $(BIN)/.installed
	$(MAKE) -C mcu size CANEFLOW=$(abspath $(BIN))/caneflow
	$(BIN)/pytest tests/test_luenberger_fixed.py tests/test_uart_frames.py tests/test_uart_gateway.py tests/test_mcu.py

# On a machine that does nothing else: what a sample costs part by part, a hop beside raw Zenoh and dora, how that grows,
# and the pipeline as a whole. `make bench REPEATS=2` takes about half an hour.
bench: $(BIN)/.installed $(WALK)
	$(BIN)/pip install --quiet --editable '.[peers]'
	$(BIN)/pytest --benchmark-enable --benchmark-only
	$(BIN)/python -m benchmarks.scaling --repeats $(REPEATS) --write docs/performance_scaling.md --overwrite
	$(BIN)/python -m benchmarks.pipeline $(WALK) --repeats $(REPEATS) --write docs/performance_pipeline.md --overwrite
	$(BIN)/python -m benchmarks.peers --repeats $(REPEATS) --write docs/performance_peers.md --overwrite  # last: fails when slower

# What is in ../shared/data through the product, and with REAL=FOLDER the files of a folder of yours: docs/results_real.md.
real: $(BIN)/.installed
	$(BIN)/python -m benchmarks.real $(if $(REAL),--mine $(REAL)) --write docs/results_real.md --overwrite

clean:
	rm -rf $(VENV) build
