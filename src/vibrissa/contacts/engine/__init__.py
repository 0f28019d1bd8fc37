"""From measurements to ranked candidates, row by row."""
