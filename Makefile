# make demo and make test set everything up by themselves; make setup does only that.
.DEFAULT_GOAL := help
.PHONY: help setup demo test slow lint bench faults study inexact kills cuts fuzz soak promise outside reproduce pictures docs examples protobuf lock dist clean

PYTHON ?= python3
BIN := .venv/bin
# keep bytecode: without it each process that tests start compiles every module again
unexport PYTHONDONTWRITEBYTECODE
# each has a target of its own
LONG_STUDIES := $(addprefix benchmarks/,diagnosis_study.py losses.py fuzz.py)
READY := .venv/.ready
PYTEST := $(BIN)/python -m pytest --numprocesses auto --dist loadfile --no-loadscope-reorder
DOCS_READY := .venv/.docs-ready
DIST_READY := .venv/.dist-ready

help: ## list the targets
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## / \t/' | expand -t 12

setup: $(READY) ## create .venv, and compile the numerical kernels

$(READY): pyproject.toml
	@if command -v uv >/dev/null 2>&1; then \
		uv venv --quiet --allow-existing --python $(PYTHON) .venv && \
		uv pip install --quiet --python $(BIN)/python --editable . --group dev; \
	else \
		$(PYTHON) -m venv .venv && \
		$(BIN)/python -m pip install --quiet --upgrade 'pip>=25.1' && \
		$(BIN)/python -m pip install --quiet --editable . --group dev; \
	fi
	@$(BIN)/python -m reactorwatch.codegen
	@touch $@

demo: $(READY) ## run a reactor with a fault, watch, record and draw it
	@$(BIN)/reactorwatch demo

test: $(READY) ## the tests, but for the slow ones: thirteen minutes on two cores
	@$(PYTEST) -m "not slow"

slow: $(READY) ## the slow tests: pages with many commands, whole fleets, kills and cuts, studies in small; twelve minutes
	@$(PYTEST) -m slow

lint: $(READY) ## style, types, and layers of imports
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

bench: $(READY) ## speed, as ratios measured in one run
	@for file in $(filter-out $(LONG_STUDIES),$(wildcard benchmarks/[a-z]*.py)); do \
		echo "== $$file"; $(BIN)/python $$file || exit 1; done

faults: $(READY) ## detection delays on a bank of faults, beside an oracle and the report's method: most of an hour
	@$(BIN)/python -m benchmarks.faults --write docs/fault_bank.md $(if $(RESULTS),--results $(RESULTS))

study: $(READY) ## the diagnosis of hidden causes; writes its tables into docs/diagnosis_study.md: hours
	@$(BIN)/python benchmarks/diagnosis_study.py --write $(if $(RESULTS),--results $(RESULTS))

inexact: $(READY) ## diagnoses of records that are not quite their model (PLANT=two-heaters|foreign|reactor N=40 SEED=1 OUT=file.jsonl, which continues)
	@$(BIN)/python -m benchmarks.inexact $(or $(PLANT),two-heaters) --n $(or $(N),40) --seed $(or $(SEED),1) $(if $(OUT),--out $(OUT))

kills: $(READY) ## kill a recorder fifty times under load, and count what is missing: three minutes
	@$(BIN)/python benchmarks/losses.py kills

cuts: $(READY) ## cut links and kill routers under load for up to 30 seconds, and count what is missing: five minutes
	@$(BIN)/python benchmarks/losses.py cuts

fuzz: $(READY) ## 200,000 random messages, commands, states and settings: no failure, no alarm; two minutes
	@$(BIN)/python benchmarks/fuzz.py

soak: $(READY) ## a fleet for ten minutes of kills, cuts and garbage, and ten on a cluster (MINUTES=10 PLANTS=200 SEED=): what is missing or repeated
	@$(BIN)/python -m benchmarks.soak $(or $(MINUTES),10) $(or $(PLANTS),200) $(SEED)
	@$(BIN)/python -m benchmarks.soak $(or $(MINUTES),10) $(or $(PLANTS),200) $(SEED) --cluster

promise: $(READY) ## false alarms beside the number promised, with equations and without; delays, statements: 20 minutes (RESULTS= continues)
	@$(BIN)/python -m benchmarks.promise $(if $(RESULTS),--results $(RESULTS))

outside: $(READY) ## public benchmarks beside other methods (DATA=folder of their data, ONLY=words of titles); writes its tables into docs/outside.md
	@$(BIN)/python -m benchmarks.outside --data $(DATA) $(if $(ONLY),--only "$(ONLY)") --write docs/outside.md

reproduce: $(READY) ## the figures of the original report, and a page of them (OUT=build/study, DATA=folder of records of others)
	@$(BIN)/python -m benchmarks.study_figures --out $(or $(OUT),build/study) $(if $(DATA),--data $(DATA))

pictures: $(READY) ## the pictures of README and docs, and docs/study.md, from real runs
	@$(BIN)/python -m docs.pictures.make

docs: $(DOCS_READY) ## the documentation site, in site/: links are checked, and it is readable without the network
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo site/index.html

examples: $(DOCS_READY) ## execute the notebooks; `make docs` then shows their figures
	@$(BIN)/python docs/execute.py

$(DOCS_READY): $(READY)
	@if command -v uv >/dev/null 2>&1; then \
		uv pip install --quiet --python $(BIN)/python --editable '.[docs]'; \
	else \
		$(BIN)/python -m pip install --quiet --editable '.[docs]'; \
	fi
	@touch $@

lock: $(READY) ## write deploy/requirements.lock: what the image installs, with hashes
	@$(BIN)/python deploy/lock.py

dist: $(DIST_READY) ## the wheel, and a bill of materials (CycloneDX) of what the image installs, in dist/
	@$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .
	@$(BIN)/cyclonedx-py requirements --pyproject pyproject.toml --output-reproducible \
		--output-file dist/reactorwatch.cdx.json deploy/requirements.lock

$(DIST_READY): $(READY)
	@$(BIN)/python -m ensurepip --upgrade >/dev/null
	@$(BIN)/python -m pip install --quiet --upgrade 'pip>=25.1'
	@$(BIN)/python -m pip install --quiet --group dist
	@touch $@

protobuf: $(READY) ## generate the message classes from messages.proto
	@cd reactorwatch/contract && ../../$(BIN)/python -m grpc_tools.protoc -I. --python_out=. --pyi_out=. messages.proto

clean: ## remove what was made
	@rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
