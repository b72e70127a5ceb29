"""The digital twin: everything that is needed to simulate the observed bodies again, in one file format."""

from masiv.twin.body import Body, Boundary, InitialCondition, Release, TwinEffect
from masiv.twin.twin import Twin

__all__ = ["Body", "Boundary", "InitialCondition", "Release", "Twin", "TwinEffect"]
