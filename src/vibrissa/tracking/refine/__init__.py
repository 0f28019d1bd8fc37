"""The rod that fits the traces: contact, force and moment."""
