"""The honest test, in parts: `studies/honest_test.py`."""
