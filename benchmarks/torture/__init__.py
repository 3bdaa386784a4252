"""Runs that are killed, signalled, and given failing file operations, thousands of times; what they leave is compared with an undisturbed run.

    python -m benchmarks.torture           `make torture`, see kills.py
    python -m benchmarks.torture.faults    `make faults`, see faults.py and cases.py

preparation.py makes the sources (sources.py) and their undisturbed runs. processes.py starts a run: forked from a process that has everything imported, or
the real command in a fresh process. trap.py arms it at one of its file operations, below the libraries by LD_PRELOAD (trap.c), or where there is no compiler
within Python alone (audit.py). comparison.py says what a run has to have in the end.
"""
