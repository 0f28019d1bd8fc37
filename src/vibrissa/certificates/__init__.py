"""Proofs that base signals locate a contact: certificates, witnesses, and their verification."""

from vibrissa.certificates.certificate import KIND, TRIPLET, Certificate, certify, load_certificate
from vibrissa.certificates.checker import Checked, check_certificate
from vibrissa.certificates.domain import Outlook, outlook, smallest_cone
from vibrissa.certificates.witness import Witness, prove_witness

__all__ = [
    "KIND",
    "TRIPLET",
    "Certificate",
    "Checked",
    "Outlook",
    "Witness",
    "certify",
    "check_certificate",
    "load_certificate",
    "outlook",
    "prove_witness",
    "smallest_cone",
]
__dir__ = __all__.copy
