# `make demo` shows the whole system on sample videos; `make test` checks everything. Both set up .venv first.

VENV := .venv
VIDEO ?=
# One more than the cores of a small machine: tests of the service mostly wait for other processes.
TEST_PROCESSES ?= 3
export OMP_WAIT_POLICY ?= passive
# Container images often set this: every process would compile torch's thousand modules anew, four seconds each.
unexport PYTHONDONTWRITEBYTECODE
# Ray and matplotlib must not phone home or open windows.
export RAY_USAGE_STATS_ENABLED := 0

.PHONY: demo test test-long setup lint types unit chaos kernels lock format audit fuzz clean

$(VENV)/.runtime: pyproject.toml requirements.lock scripts/setup.sh
	@scripts/setup.sh
	@touch $@

$(VENV)/.dev: pyproject.toml requirements.lock scripts/setup.sh
	@scripts/setup.sh postgres dev
	@touch $@ $(VENV)/.runtime

setup: $(VENV)/.dev ## .venv with everything

demo: $(VENV)/.runtime ## run the service on sample videos, or on VIDEO=clip.mp4
	@$(VENV)/bin/vipectl demo $(if $(VIDEO),"$(VIDEO)")

test: setup lint ## everything that CI runs
	@$(MAKE) --no-print-directory --jobs=2 types unit

test-long: setup ## what takes too long for CI
	$(VENV)/bin/python -m pytest --numprocesses $(TEST_PROCESSES) --dist worksteal -m long $(PYTEST_ARGS)

lint: setup
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/ruff check .
	$(VENV)/bin/lint-imports

types: setup
	$(VENV)/bin/mypy

# Before the tests, which would compile the same kernels in several processes at once.
KERNELS := $(shell grep -rl --include='*.py' 'vipe_core.compilation import' vipe_core)
$(VENV)/.warm: $(VENV)/.dev $(KERNELS)
	$(VENV)/bin/vipectl warmup
	@touch $@

unit: setup $(VENV)/.warm
	$(VENV)/bin/python -m pytest --numprocesses $(TEST_PROCESSES) --dist worksteal $(PYTEST_ARGS)

SEED ?= 1
MINUTES ?= 5
chaos: setup ## a job of 64 videos while everything around it breaks; SEED=2 MINUTES=3 for another run
	$(VENV)/bin/python -m benchmarks.chaos --seed $(SEED) --minutes $(MINUTES)

kernels: setup ## compile every CUDA kernel of bundle adjustment for three generations of GPUs; needs none
	$(VENV)/bin/python -m benchmarks.ba_kernels

format: setup
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

lock: ## resolve all dependencies anew into requirements.lock
	scripts/lock.sh

audit: setup ## known vulnerabilities of the locked versions, and licences
	@scripts/audit.sh

fuzz: setup ## damaged bytes for every reader of bytes from outside, for half an hour
	$(VENV)/bin/python -m benchmarks.fuzz --minutes 30

clean: ## remove the environment, caches and the demo's output, nothing of yours
	rm -rf $(VENV) .cache .mypy_cache .ruff_cache .import_linter_cache .pytest_cache .hypothesis vipe_output/demo
