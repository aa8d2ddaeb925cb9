"""Stages spoiled at random, and what becomes of them: ``python -m tests.fuzz --help``."""
