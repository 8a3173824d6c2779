"""Faults on purpose: ``PYTHONPATH=tests python -m torture`` kills, fuzzes, poisons and soaks.

tests/test_torture.py runs the short form of the same.
"""
