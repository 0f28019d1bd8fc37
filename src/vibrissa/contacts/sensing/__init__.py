"""Channels of measurements, their noise, weights and derivatives."""
