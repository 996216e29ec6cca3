"""Measuring the engine: synthetic clips with exact truth, metrics, and a picture of the result."""
