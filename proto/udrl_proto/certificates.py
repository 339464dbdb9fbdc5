"""Checks of a role's key and certificates.

Importing this module needs the extra ``secure``.
"""

from datetime import UTC, datetime
from pathlib import Path

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509 import Certificate, load_pem_x509_certificate
from cryptography.x509.oid import NameOID

from udrl.errors import ConfigError

#: Remedy for a damaged key or certificate.
_ANEW = "copy it again, or create new keys with `udrl keys create`"


def check_certificate(ca: Path, certificate: Path, key: Path, role: str) -> None:
    """Check the files with which a service proves its role.

    Raises:
        ConfigError: a file is missing, unreadable, expired, for another role, or does not match the
            others.
    """
    issuer, ours = _certificate(ca, role), _certificate(certificate, role)
    try:
        private = load_pem_private_key(_read(key, role), password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise ConfigError(f"{key}: not a private key in PEM without a password; {_ANEW}") from error
    if private.public_key() != ours.public_key():
        raise ConfigError(
            f"{key} is not the key of {certificate}; copy both from the same folder again"
        )
    names = ours.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    named = names[0].value if names else ""
    if named != role:
        raise ConfigError(
            f"{certificate} is for the role {named!r}, expected {role!r}; give the folder {role} "
            f"that `udrl keys create` made, or the folder above it"
        )
    try:
        ours.verify_directly_issued_by(issuer)
    except (ValueError, TypeError, InvalidSignature) as error:
        raise ConfigError(
            f"{certificate} was not issued by {ca}; copy both from the same folder again"
        ) from error


def _read(path: Path, role: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"{path}: {error.strerror}; --keys expects the folder that `udrl keys create` made, or "
            f"its folder {role}"
        ) from error


def _certificate(path: Path, role: str) -> Certificate:
    """Return a certificate, after checking that it is valid now."""
    data = _read(path, role)
    try:
        certificate = load_pem_x509_certificate(data)
    except ValueError as error:
        raise ConfigError(f"{path}: not a certificate in PEM; {_ANEW}") from error
    now = datetime.now(UTC)
    begin, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if now > end:
        raise ConfigError(
            f"{path} expired at {end:%Y-%m-%d %H:%M} UTC; create new keys with `udrl keys create`"
        )
    if now < begin:
        raise ConfigError(
            f"{path} is valid from {begin:%Y-%m-%d %H:%M} UTC, but the clock here says "
            f"{now:%Y-%m-%d %H:%M}; correct the clock"
        )
    return certificate
