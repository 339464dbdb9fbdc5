"""A service's credentials: its private key, its certificate and the certificate authority.

A folder holds three PEM files: ``ca.pem``, ``cert.pem``, ``key.pem``. ``udrl keys create`` creates
one folder per role. Keys are handled and logged by path only.
"""

import logging
import os
import socket
import ssl
from pathlib import Path
from typing import NamedTuple

from udrl.errors import ConfigError

log = logging.getLogger("udrl")

CA, CERTIFICATE, KEY = "ca.pem", "cert.pem", "key.pem"

#: Timeout of the TLS check of an endpoint, seconds.
_EXAMINE_S = 1.0
#: Seconds to wait for a server to reject our certificate.
_VERDICT_S = 0.3
#: OpenSSL's codes for a mismatch of host name or IP address.
_OTHER_NAME = (62, 64)
#: Parts of the names of OpenSSL's errors if a server rejects our certificate.
_REJECTIONS = ("CERTIFICATE", "UNKNOWN_CA", "DECRYPT_ERROR")

_SAME_KEYS = "both sides need keys from the same `udrl keys create`"


class Credentials(NamedTuple):
    """The files with which a service proves its role, checked by :func:`load_credentials`.

    Attributes:
        ca: certificate of the authority; peers without a certificate issued by it are rejected.
        certificate: the service's own certificate; its common name is the role.
        key: private key of that certificate.
    """

    ca: Path
    certificate: Path
    key: Path

    def settings(self) -> dict[str, str | bool]:
        """Return Zenoh's settings for mutual TLS, both to listen and to connect."""
        tls = "transport/link/tls/"
        return {
            tls + "root_ca_certificate": str(self.ca),
            tls + "listen_certificate": str(self.certificate),
            tls + "listen_private_key": str(self.key),
            tls + "connect_certificate": str(self.certificate),
            tls + "connect_private_key": str(self.key),
            tls + "enable_mtls": True,
            tls + "verify_name_on_connect": True,
            tls + "close_link_on_expiration": True,
        }

    def examine(self, host: str, port: int) -> None:
        """Check whether TLS is why connecting failed; Zenoh does not report the reason.

        Raises:
            ConfigError: one side does not trust the other's certificate.
        """
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.load_verify_locations(self.ca)
        context.load_cert_chain(self.certificate, self.key)
        try:
            with (
                socket.create_connection((host, port), _EXAMINE_S) as plain,
                context.wrap_socket(plain, server_hostname=host) as secured,
            ):
                # In TLS 1.3 a server rejects a client's certificate only after the handshake.
                secured.settimeout(_VERDICT_S)
                secured.recv(1)
        except ssl.SSLCertVerificationError as error:
            remedy = (
                f"create new keys with --host {host}, or connect by a name in the certificate"
                if error.verify_code in _OTHER_NAME
                else _SAME_KEYS
            )
            raise ConfigError(
                f"the certificate shown at tls/{host}:{port} is not trusted: "
                f"{error.verify_message}; {remedy}"
            ) from error
        except ssl.SSLError as error:
            # Other errors, e.g. of a server that dies during the check, are worth a retry.
            if any(word in (error.reason or "") for word in _REJECTIONS):
                raise ConfigError(
                    f"tls/{host}:{port} does not trust {self.certificate} ({error.reason}); "
                    f"{_SAME_KEYS}"
                ) from error
        except OSError:
            return


def load_credentials(folder: Path, role: str) -> Credentials:
    """Return the credentials of a role.

    Args:
        folder: the role's folder, or the folder above it.
        role: one of :data:`udrl_proto.access.ROLES`.

    Raises:
        ConfigError: a file is missing, unreadable, expired, for another role, or does not match the
            others; or the extra ``secure`` is not installed.
    """
    try:
        from udrl_proto import certificates
    except ModuleNotFoundError as error:
        raise ConfigError(
            '--keys needs cryptography; install it with: pip install "udrl[secure]"'
        ) from error
    own = (folder / role if os.path.isdir(folder / role) else folder).absolute()
    found = Credentials(own / CA, own / CERTIFICATE, own / KEY)
    certificates.check_certificate(*found, role)
    file = found.key.stat()
    # A key owned by root, as in Kubernetes, can be made readable for a service only by group.
    may = 0o640 if file.st_uid == 0 and os.geteuid() != 0 else 0o600
    if file.st_mode & 0o777 & ~may:
        log.warning("%s can be read by others; chmod 600 it", found.key)
    return found
