"""Constitutive laws. One interface for all: ``masiv.materials.law.Law``."""
