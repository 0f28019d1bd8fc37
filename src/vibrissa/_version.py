"""The version, read by the build and by whatever names its origin."""

__version__ = "0.1.0"
