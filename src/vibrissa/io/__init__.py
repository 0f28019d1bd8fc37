"""Files and nothing else: one module a format."""

from vibrissa.io.centerline import load_centerline, load_whisker, save_centerline

__all__ = ["load_centerline", "load_whisker", "save_centerline"]
