.DEFAULT_GOAL := help
.PHONY: help setup demo ten-seeds results check test nightly mutants bench dist docs release image pins

# Each package is compiled once, also where a container says otherwise: else every process compiles LeRobot anew.
export PYTHONDONTWRITEBYTECODE :=

# One thread for each worker of a parallel run: torch and lavapipe would each take every core.
PYTEST := OMP_NUM_THREADS=1 LP_NUM_THREADS=1 .venv/bin/pytest
PARALLEL := $(PYTEST) -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder --durations=20

NIGHTLY = $(shell grep -rlE --include='test_*.py' 'mark\.nightly|import KINDS' tests)
CONTENT = $(shell git ls-files -zco --exclude-standard | xargs -0 sha1sum 2>/dev/null | sha1sum | cut -c 1-12)

ENGINE ?= $(firstword $(foreach tool,docker podman buildah,$(shell command -v $(tool))))

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-10s %s\n", $$1, $$2}' Makefile

setup: ## make .venv/ and install what it needs from the system
	@./setup.sh

demo: setup ## demonstrations, training, evaluation and a video, end to end
	@examples/demo.sh

ten-seeds: setup ## ten training seeds of frozen_vit on the fast set as a study, with its report
	.venv/bin/constructskill-study ten_seeds
	.venv/bin/constructskill-report --root=outputs/study/ten_seeds

results: setup ## the published results that are missing or of older code, a piece at a time, each committed (MINUTES=120)
	.venv/bin/python results/make.py $(if $(MINUTES),--minutes=$(MINUTES))

check: setup ## lint, types, and the tests that need neither simulator nor training
	.venv/bin/ruff check
	.venv/bin/ruff format --check
	.venv/bin/mypy | .venv/bin/mypy-baseline filter
	$(PARALLEL) -q -m "not sim and not slow and not nightly"

test: setup ## whatever a change is likely to break
	$(PARALLEL) -m "not nightly"

nightly: ## the longest tests; a file that passed is skipped until something changes, so a killed run goes on
	@./setup.sh chromium
	@$(MAKE) --no-print-directory --jobs=$$(nproc) --keep-going --output-sync PASSED=outputs/nightly/$(CONTENT) passed

ifdef PASSED
passed: $(NIGHTLY:%.py=$(PASSED)/%)

$(PASSED)/%: %.py
	@echo "== $<" && $(PYTEST) -q --durations=5 -m nightly $<
	@mkdir -p $(@D) && touch $@
endif

mutants: setup ## sixty drawn edits of the package, each against the tests that reach it
	.venv/bin/python tests/mutants.py

bench: setup ## the speed claims of docs/speed.md but those marked ‡, side by side on this machine, into benchmarks/RESULTS.md
	.venv/bin/python benchmarks/run.py

dist: setup ## the wheel and the source distribution, into dist/
	.venv/bin/python -m build --no-isolation

image: ## the image for vla-evaluation-harness, by docker, podman or buildah; BASE=another Debian 13
	$(ENGINE) build -t constructskill \
		-f examples/vla_evaluation_harness/Dockerfile $(if $(BASE),--build-arg BASE=$(BASE)) .

docs: setup ## the documentation as a site, without addresses of other hosts: outputs/site/index.html
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --strict

release: setup ## wheel, source distribution, site, and what goes to the Hub under HUB=NAME (DRAFT=1 while results are missing)
	@test '$(HUB)' || { echo "Name the user or organisation on the Hub: make release HUB=NAME" >&2; exit 2; }
	.venv/bin/constructskill-board --root=board --films=true
	@$(MAKE) --no-print-directory dist docs
	.venv/bin/python results/release.py --user=$(HUB) $(if $(DRAFT),--draft)

pins: ## resolve pyproject.toml afresh into constraints.txt, for x86-64 Linux and Python 3.12
	PATH="$$PWD/.venv-uv/bin:$$PATH" uv pip compile pyproject.toml --quiet --upgrade --all-extras --python-version 3.12 \
		--no-annotate --custom-compile-command="make pins" --output-file constraints.txt
