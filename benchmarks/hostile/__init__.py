"""Inputs that mean harm, made by code: what the tests, the fuzzer and the table of bad inputs have in common."""
