"""Creating keys: a private certificate authority, and a certificate for each role.

Needs the extra ``secure``.
"""

import ipaddress
import os
import re
import secrets
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from udrl.errors import ConfigError
from udrl_proto.access import REPLAY, ROLES
from udrl_proto.credentials import CA, CERTIFICATE, KEY, load_credentials

#: Folder of the authority itself, which is not copied to other machines, and its key file.
AUTHORITY, AUTHORITY_KEY = "ca", "ca.key"

#: Names of the loopback interface, for which the replay service's certificate is always valid.
_ALWAYS = ("localhost", "127.0.0.1", "::1")
#: A part of a host name, and a host name.
_LABEL = r"[A-Za-z0-9_](?:[A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?"
_HOST = re.compile(rf"(?=.{{1,253}}\Z){_LABEL}(?:\.{_LABEL})*")
#: Clocks differ between machines, so certificates are valid from slightly earlier.
_CLOCKS_DIFFER = timedelta(hours=1)


def create_keys(folder: Path, hosts: Iterable[str] = (), valid: timedelta = timedelta(365)) -> None:
    """Create an authority, and a folder with key and certificate for each role.

    Args:
        folder: must not exist, or contain only folders, such as volumes.
        hosts: host names and IP addresses of the replay service. Those of the loopback interface
            are always included.
        valid: validity of all certificates.

    Raises:
        ConfigError: a host is invalid, or the folder is not empty or cannot be written.
    """
    names = [_alternative(host) for host in dict.fromkeys((*_ALWAYS, *hosts))]
    authority = _Authority(valid)
    files = {
        Path(AUTHORITY, CA): authority.certificate,
        Path(AUTHORITY, AUTHORITY_KEY): _pem(authority.key),
    }
    for role in ROLES:
        key = ec.generate_private_key(ec.SECP256R1())
        files[Path(role, CA)] = authority.certificate
        files[Path(role, CERTIFICATE)] = authority.issue(
            role, key.public_key(), names if role == REPLAY else []
        )
        files[Path(role, KEY)] = _pem(key)
    try:
        if any(not path.is_dir() for path in folder.rglob("*")):
            raise ConfigError(
                f"{folder} is not empty, and keys are never overwritten; use another folder, or "
                f"remove this one first"
            )
        _write(folder, files)
    except OSError as error:
        raise ConfigError(
            f"cannot write keys to {folder}: {error.strerror}; use another folder"
        ) from error


def has_keys(folder: Path, hosts: Iterable[str] = ()) -> bool:
    """Return whether a folder has keys for every role, valid for these hosts.

    Raises:
        ConfigError: the keys are expired, do not match or lack a host.
    """
    files = [folder / role / name for role in ROLES for name in (CA, CERTIFICATE, KEY)]
    if not all(map(os.path.isfile, files)):
        return False
    for role in ROLES:
        load_credentials(folder, role)
    certificate = x509.load_pem_x509_certificate((folder / REPLAY / CERTIFICATE).read_bytes())
    named = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    for host in hosts:
        if _alternative(host) not in named:
            raise ConfigError(
                f"the keys in {folder} are not valid for --host {host}; remove them and create new "
                f"ones for all services, or use a host that they include"
            )
    return True


class _Authority:
    """A certificate authority. Holders of its certificates trust no other authority."""

    def __init__(self, valid: timedelta) -> None:
        self.key = ec.generate_private_key(ec.SECP256R1())
        now = datetime.now(UTC)
        self._valid = now - _CLOCKS_DIFFER, now + valid
        # A unique name, so that authorities cannot be confused.
        self._name = _name(f"udrl authority {secrets.token_hex(4)}")
        self.certificate = self._signed(
            self._builder(self._name, self.key.public_key())
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_usage(signs_certificates=True), critical=True)
        )

    def issue(
        self, role: str, key: ec.EllipticCurvePublicKey, names: list[x509.GeneralName]
    ) -> bytes:
        """Return a certificate in PEM. It is valid for servers only if ``names`` are given."""
        purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
        builder = self._builder(_name(role), key)
        if names:
            purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
            builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        return self._signed(
            builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=True)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs_certificates=False), critical=True)
        )

    def _builder(
        self, subject: x509.Name, key: ec.EllipticCurvePublicKey
    ) -> x509.CertificateBuilder:
        ours = self.key.public_key()
        return (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(self._name)
            .public_key(key)
            .serial_number(x509.random_serial_number())
            .not_valid_before(self._valid[0])
            .not_valid_after(self._valid[1])
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(ours), critical=False)
        )

    def _signed(self, builder: x509.CertificateBuilder) -> bytes:
        return builder.sign(self.key, SHA256()).public_bytes(Encoding.PEM)


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _alternative(host: str) -> x509.GeneralName:
    """Return a host as an alternative name of a certificate's subject.

    Raises:
        ConfigError: it is neither a host name nor an IP address.
    """
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        if _HOST.fullmatch(host):
            return x509.DNSName(host)
    raise ConfigError(
        f"--host {host!r}: expected a host name or an IP address without a port, e.g. "
        f"replay.example.org or 10.0.0.1"
    )


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def _write(folder: Path, files: dict[Path, bytes]) -> None:
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    for path, content in files.items():
        (folder / path).parent.mkdir(mode=0o700, exist_ok=True)
        mode = 0o600 if path.name in (KEY, AUTHORITY_KEY) else 0o644
        with os.fdopen(
            os.open(folder / path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb"
        ) as file:
            file.write(content)
