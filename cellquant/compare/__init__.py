"""Experiment and simulation side by side: figures, reports, units, parameters."""
