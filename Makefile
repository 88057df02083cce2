# Each target sets up what it needs, in .venv; nothing has to be installed before but Python 3.11 or newer.
# ARGS is passed on:  make demo ARGS=--help    make test ARGS='--only unit -- -k crc'
.POSIX:
.PHONY: help demo test test-all release soak hour bench conformance golden docs pictures wheels deb lint prose clean

help:
	@echo 'make demo      show the gateway at work, without any hardware      (ARGS="...": see make demo ARGS=--help)'
	@echo 'make test      ruff, mypy, tests, the core of the tests on a real vcan   (ARGS="--only lint|types|unit|vcan -- -k crc")'
	@echo 'make test-all  what make test leaves out: faults, systemd, browser, broker, CANopen masters of others'
	@echo '                                        (ARGS="--only faults|tools|masters")'
	@echo 'make release   by hand, on a quiet machine, for hours: faults on emulated hardware, random faults, a recorded hour'
	@echo '                                        (ARGS="--only qemu|soak|hour|put-in|machines|fuzz|wheels|deb")'
	@echo 'make soak      random faults for ten minutes   (ARGS="--minutes 60 --seed 1")'
	@echo 'make hour      a recorded hour through every format, read back and compared   (ARGS="--minutes 6")'
	@echo 'make bench     speed, delay and memory beside a C program and the obvious one   (ARGS="--list" ARGS="--only cpu --seconds 10")'
	@echo 'make conformance  test the CANopen node against CiA 301, 305, 306 and write the report   (another slave: ARGS="--node 5 --eds x.eds --channel can0")'
	@echo 'make golden    record the golden set anew and say what changed   (ARGS="--check" ARGS="flights/v4")'
	@echo 'make docs      write docs/reference from the sources'
	@echo 'make pictures  draw docs/pictures: live screen and report; all sizes of them by ARGS=FOLDER'
	@echo 'make wheels    one wheel with the core in C for x86-64, arm64 and armv7, looked through   (ARGS=FOLDER)'
	@echo 'make deb       Debian packages for amd64, arm64 and armhf, with all libraries   (ARGS=FOLDER)'
	@echo 'make lint      ruff and mypy only'
	@echo 'make prose     how plain the English is and how dense the code   (ARGS="--worst 12" ARGS="--hits PATH")'
	@echo 'make clean     remove .venv and all caches'

demo:
	@tests/bootstrap.sh demo
	@.venv/bin/kontronik-can-gw demo $(ARGS)

test:
	@tests/bootstrap.sh test
	@.venv/bin/python tests/run.py test $(ARGS)

test-all:
	@tests/bootstrap.sh test-all
	@.venv/bin/python tests/run.py test-all $(ARGS)

release:
	@tests/bootstrap.sh release
	@.venv/bin/python tests/run.py release $(ARGS)

soak:
	@tests/bootstrap.sh release
	@.venv/bin/python tests/faults/programme.py soak $(ARGS)

hour:
	@tests/bootstrap.sh lint
	@.venv/bin/python tests/hour/hour_programme.py $(ARGS)

bench:
	@tests/bootstrap.sh lint
	@.venv/bin/python tests/benchmarks/bench.py $(ARGS)

conformance:
	@tests/bootstrap.sh test
	@if [ -n "$(ARGS)" ]; then \
		.venv/bin/kontronik-can-gw conformance $(ARGS); \
	else \
		mkdir -p build/conformance && \
		tests/vm/run --rw build/conformance -- \
			.venv/bin/python tests/vcan/conformance_report.py build/conformance && \
		cp build/conformance/conformance.md docs/reference/conformance.md; \
	fi

golden:
	@tests/bootstrap.sh lint
	@.venv/bin/python tests/golden/record.py $(ARGS)

docs:
	@tests/bootstrap.sh lint
	@.venv/bin/python tests/readme/reference.py

pictures:
	@tests/bootstrap.sh pictures
	@PYTHONPATH=tests/cli:tests/report .venv/bin/python tests/readme/pictures.py $(ARGS)

wheels:
	@tests/bootstrap.sh wheels
	@.venv/bin/python tests/native/wheels.py $(ARGS)

deb:
	@tests/bootstrap.sh wheels
	@.venv/bin/python deb/make_deb.py $(ARGS)

lint:
	@tests/bootstrap.sh lint
	@.venv/bin/python tests/run.py test --only lint --only types

prose:
	@tests/bootstrap.sh lint
	@.venv/bin/python tests/prose/plain_english.py $(ARGS)

clean:
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis tests/vm/.cache tests/foreign/.cache tests/deb/.cache build dist
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
