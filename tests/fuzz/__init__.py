"""A seeded, structure-aware fuzzer of everything that reads files: `python -m tests.fuzz --inputs 100000 --seed 0`."""
