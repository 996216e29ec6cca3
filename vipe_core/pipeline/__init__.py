"""Presets (`presets`), and the annotator that runs them (`annotator`; public as `vipe_core.Annotator`).

Imports nothing by itself: the API offers presets without loading the engine.
"""
