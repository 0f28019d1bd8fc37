"""Proofs that base signals locate a contact: validated mechanics and certificates."""

from vibrissa.certificates.certificate import TRIPLET, Certificate, certify, load_certificate
from vibrissa.certificates.grid import Outlook, outlook

__all__ = [
    "TRIPLET",
    "Certificate",
    "Outlook",
    "certify",
    "load_certificate",
    "outlook",
]
