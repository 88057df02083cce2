# Each target sets up what it needs, in .venv; nothing has to be installed before but Python 3.11 or newer.
# ARGS is passed on:  make demo ARGS=--help    make test ARGS='--only unit -- -k crc'
.POSIX:
.PHONY: help demo test test-hardware soak hour bench golden lint clean

help:
	@echo 'make demo    show the gateway at work, without any hardware      (ARGS="...": see make demo ARGS=--help)'
	@echo 'make test    all checks: ruff, mypy, tests, tests on real vcan   (ARGS="--only lint|types|unit|vcan|faults")'
	@echo 'make test-hardware   the fault programme on real drivers in virtual machines   (ARGS="--long --table --keep FOLDER")'
	@echo 'make soak    random faults for ten minutes   (ARGS="--minutes 60 --seed 1")'
	@echo 'make hour    a recorded hour through every format, read back and compared   (ARGS="--minutes 6 --escs 3")'
	@echo 'make bench   speed, delay and memory beside a C program and the obvious one   (ARGS="--list" ARGS="--only cpu --seconds 10")'
	@echo 'make golden  record the golden set anew and say what changed   (ARGS="--check" ARGS="flights/v4")'
	@echo 'make lint    ruff and mypy only'
	@echo 'make clean   remove .venv and all caches'

demo:
	@tests/bootstrap.sh demo
	@.venv/bin/kontronik-can-gw demo $(ARGS)

test:
	@tests/bootstrap.sh test
	@.venv/bin/python tests/run.py $(ARGS)

test-hardware:
	@tests/bootstrap.sh hardware
	@.venv/bin/python tests/run.py --only faults $(ARGS)

soak:
	@tests/bootstrap.sh hardware
	@.venv/bin/python tests/run.py --only soak $(ARGS)

hour:
	@tests/bootstrap.sh lint
	@.venv/bin/python tests/hour/hour_programme.py $(ARGS)

bench:
	@tests/bootstrap.sh lint
	@.venv/bin/python tests/benchmarks/bench.py $(ARGS)

golden:
	@tests/bootstrap.sh lint
	@.venv/bin/python tests/golden/record.py $(ARGS)

lint:
	@tests/bootstrap.sh lint
	@.venv/bin/python tests/run.py --only lint --only types

clean:
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis tests/vm/.cache tests/foreign/.cache build dist
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
