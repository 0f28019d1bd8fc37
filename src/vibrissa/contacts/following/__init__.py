"""Contacts over time: the filter and events."""
