# Everything runs in .venv, which the first target that needs it makes: only Python >= 3.11, git and make are required.

RECENT := import sys; sys.exit(sys.version_info < (3, 11))
VERSION := import sys; print("is %d.%d" % sys.version_info[:2])

# python3 unless it is too old and a newer one stands beside it; `make PYTHON=...` overrides.
PYTHON ?= $(shell for python in python3 python3.11 python3.12 python3.13; do \
	$$python -c '$(RECENT)' 2>/dev/null && echo $$python && exit; done; echo python3)
RUN := .venv/bin/python -m
READY := .venv/ready

.PHONY: setup test quick soak lint docs kick view train bench clean

setup: $(READY)

# The stamp is touched last, so that an interrupted set-up is taken up again by the next make.
$(READY): pyproject.toml constraints.txt
	$(if $(shell $(PYTHON) -c '$(RECENT)' 2>/dev/null && echo recent),,$(error \
	Python >= 3.11 is needed, PYTHON=$(PYTHON) $(shell $(PYTHON) -c '$(VERSION)' 2>/dev/null || echo cannot be run)))
	@rm -f $@
	@echo "Setting up .venv: a few minutes the first time"
	@.venv/bin/python -c 'import pip; $(RECENT)' 2>/dev/null || $(PYTHON) -m venv --clear .venv
	@$(RUN) pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[test]'
	@touch $@

# Two at a time: most of it is compilation, which keeps one core busy.
test: $(READY)
	@$(RUN) pytest -n 2 --dist loadfile tests

quick: $(READY)
	@$(RUN) pytest -n 2 --dist loadfile -m "not slow and not soak" tests

# Thousands of random scenes and damaged files, some twenty minutes, and 200 random films, two hours.
soak: $(READY)
	@$(RUN) pytest -n 2 -m soak tests

lint: $(READY)
	$(RUN) ruff check
	$(RUN) ruff format --check
	$(RUN) mypy

# The documentation, to be read from site/index.html.
docs: $(READY)
	$(RUN) mkdocs build --strict

kick: $(READY)
	@$(RUN) tasks.kick

view: $(READY)
	@$(RUN) tasks.kick --view

train: $(READY)
	@$(RUN) tasks.train

KICK := $(RUN) tasks.benchmarks.kick --seed 7 --publish
MODEL := $(RUN) tasks.benchmarks.model --sequences 256 --publish

bench: $(READY)
	$(RUN) tasks.benchmarks.speed --publish
	$(RUN) tasks.benchmarks.compilation --publish
	$(RUN) tasks.benchmarks.content --publish
	$(RUN) tasks.benchmarks.tradeoff --publish
	$(RUN) tasks.benchmarks.optimizers --publish
	$(RUN) tasks.benchmarks.stability --publish
	$(RUN) tasks.benchmarks.damaged_files --publish --files 100000
	$(RUN) tasks.benchmarks.page --kicks 200 --publish
	for scene in chains1 chains2 human_ball; do $(RUN) tasks.train --scene $$scene --design paper --effort 0.5 || exit; done
	$(MODEL) --scene human_ball --seed 2 --beside paper
	for scene in chains1 chains2; do $(MODEL) --scene $$scene --seed 2 --beside paper --bullet || exit; done
	$(MODEL) --scene chain4 --seed 2 --bullet
	for scene in human_capsule any_human any_human_alone full_human; do $(MODEL) --scene $$scene --seed 2 || exit; done
	$(MODEL) --scene human_ball --seed 2 --bodies varied
	$(RUN) tasks.benchmarks.gap --targets 8 --seed 7 --publish
	for preset in fast balanced accurate; do $(RUN) tasks.benchmarks.kick --publish --targets 64 --seed 11 --preset $$preset || exit; done
	for preset in fast balanced accurate; do $(KICK) --targets 32 --preset $$preset --substeps 20 || exit; done
	for model in larp mujoco; do $(KICK) --targets 32 --preset balanced --budget 1 --dynamics $$model || exit; done
	for model in larp mujoco; do $(KICK) --targets 32 --preset accurate --budget 5 --dynamics $$model || exit; done
	$(KICK) --targets 8 --preset accurate --noise
	$(KICK) --targets 32 --noise
	$(KICK) --targets 32 --rolling 2
	for height in 1.6 1.9; do $(KICK) --height $$height || exit; done
	$(KICK) --targets 32 --bodies varied
	$(KICK) --body full

# Keeps runs/: results are never thrown away by a clean-up.
clean:
	rm -rf .venv build site *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
