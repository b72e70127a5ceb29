"""Fits of few parameters, noise models, evidence."""
