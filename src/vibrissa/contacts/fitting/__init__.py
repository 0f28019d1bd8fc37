"""Contacts of given signals: exact solutions and least squares."""
