"""Who a service is: its private key, its certificate, and the authority that both sides trust.

A folder holds three files in PEM: ``ca.pem``, ``cert.pem``, ``key.pem``. ``udrl keys create`` makes
one folder for each role. Nothing here, and no log line, holds more of a key than its path.
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

#: Seconds to find out why an endpoint that is there cannot be used.
_EXAMINE_S = 1.0
#: Seconds for a server to say that it does not like our certificate.
_VERDICT_S = 0.3
#: OpenSSL's codes for a certificate of another host name or IP address.
_OTHER_NAME = (62, 64)
#: What OpenSSL calls a server's complaint about our certificate.
_COMPLAINTS = ("CERTIFICATE", "UNKNOWN_CA", "DECRYPT_ERROR")

_SAME_KEYS = "both sides need keys of the same `udrl keys create`"


class Credentials(NamedTuple):
    """The files that a service proves its role with; :func:`load` has checked them.

    Attributes:
        ca: certificate of the authority; who shows none of its certificates is not talked to.
        certificate: ours; its common name is our role.
        key: the private key of it.
    """

    ca: Path
    certificate: Path
    key: Path

    def settings(self) -> dict[str, str | bool]:
        """Return Zenoh's settings for mutual TLS, for those who listen and those who connect."""
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
        """Find out whether TLS is why an endpoint cannot be used; Zenoh says only that it cannot.

        Raises:
            ConfigError: its certificate is not trusted, or ours is not trusted there.
        """
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.load_verify_locations(self.ca)
        context.load_cert_chain(self.certificate, self.key)
        try:
            with (
                socket.create_connection((host, port), _EXAMINE_S) as plain,
                context.wrap_socket(plain, server_hostname=host) as secured,
            ):
                # In TLS 1.3 the verdict on a client's certificate comes after the handshake.
                secured.settimeout(_VERDICT_S)
                secured.recv(1)
        except ssl.SSLCertVerificationError as error:
            remedy = (
                f"make new keys with --host {host}, or connect by a name that it has"
                if error.verify_code in _OTHER_NAME
                else _SAME_KEYS
            )
            raise ConfigError(
                f"the certificate shown at tls/{host}:{port} is not trusted: "
                f"{error.verify_message}; {remedy}"
            ) from error
        except ssl.SSLError as error:
            # Only what says so: a server that dies meanwhile is no reason to give up.
            if any(word in (error.reason or "") for word in _COMPLAINTS):
                raise ConfigError(
                    f"tls/{host}:{port} does not trust {self.certificate} ({error.reason}); "
                    f"{_SAME_KEYS}"
                ) from error
        except OSError:
            return


def load(folder: Path, role: str) -> Credentials:
    """Return the credentials of a role.

    Args:
        folder: its own, or the one with a folder for each role.
        role: from :data:`udrl_proto.access.ROLES`.

    Raises:
        ConfigError: a file is missing, unreadable, expired, another role's, or does not fit the
            others; or the extra ``secure`` is not installed.
    """
    try:
        from udrl_proto import certificates
    except ModuleNotFoundError as error:
        raise ConfigError(
            '--keys needs cryptography; install it with: pip install "udrl[secure]"'
        ) from error
    own = (folder / role if (folder / role).is_dir() else folder).absolute()
    found = Credentials(own / CA, own / CERTIFICATE, own / KEY)
    certificates.check(*found, role)
    file = found.key.stat()
    # Where root gives a key to a service, as Kubernetes does, it can only be by way of a group.
    may = 0o640 if file.st_uid == 0 and os.geteuid() != 0 else 0o600
    if file.st_mode & 0o777 & ~may:
        log.warning("%s can be read by others; chmod 600 it", found.key)
    return found
