"""Support for compiled kernels: array types, compilation, the cache on disk."""
