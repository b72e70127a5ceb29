"""Rollouts of a twin, as filmed or varied."""
