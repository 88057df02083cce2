"""The broker: where it is and how to connect, what can be checked beforehand, and why a connection failed, with the remedy."""

import os
import socket
import ssl
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kontronik_can_gw.config.keys import MqttConfig
from kontronik_can_gw.errors import RunError

# Reason codes of MQTT 5, to which paho translates those of MQTT 3.
_BAD_CLIENT_ID = 133
_NOT_ALLOWED = (134, 135)


@dataclass(frozen=True)
class Broker:
    """Where to connect and how. The password and the certificate to show are read at each connection, since they may be renewed."""

    config: MqttConfig
    """The table [mqtt], with a broker; names of files are absolute."""
    client_id: str

    @property
    def address(self) -> tuple[str, int]:
        assert self.config.address is not None
        return self.config.address

    @property
    def place(self) -> str:
        host, port = self.address
        return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"

    def __str__(self) -> str:
        return f"MQTT broker {self.place}"


class Refused(OSError):
    """The connection is impossible now. The text includes the remedy."""


def check(broker: Broker) -> list[str]:
    """Check the library and the files, without connecting. Returns warnings; RunError where it cannot work."""
    try:
        from paho.mqtt.enums import CallbackAPIVersion  # noqa: F401
    except ImportError:
        raise RunError("needs paho-mqtt 2: pip install 'kontronik-can-gw[mqtt]'") from None
    warnings = []
    file, is_encrypted = broker.config.password_file, broker.config.tls
    try:
        if is_encrypted:
            tls_context(broker.config)
        if file is not None:
            password(file)
            if Path(file).stat().st_mode & stat.S_IROTH:
                warnings.append(
                    f"{file}: can be read by everybody on this machine. Run: chmod o= {file}"
                )
    except Refused as error:
        raise RunError(str(error)) from None
    is_local = broker.address[0].startswith(("localhost", "::1", "127."))
    if file is not None and not is_encrypted and not is_local:
        warnings.append(
            f"{broker}: without TLS the password can be read by all on the way. Use --tls."
        )
    return warnings


def password(file: str) -> str:
    """The password in the first line of a file."""
    try:
        text = Path(file).read_text(encoding="utf-8")
    except OSError as error:
        raise Refused(f"{file}: the password cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise Refused(f"{file}: the password is not text in UTF-8") from None
    line = text.partition("\n")[0].rstrip("\r")
    if not line:
        raise Refused(f"{file}: has no password on its first line")
    return line


def tls_context(config: MqttConfig) -> ssl.SSLContext:
    """TLS 1.2 or newer, with the broker's certificate and name checked."""
    for key in ("ca_file", "cert_file", "key_file"):
        file = getattr(config, key)
        if file is not None and not os.access(file, os.R_OK):
            raise Refused(f"{file}: mqtt.{key} cannot be read")
    try:
        context = ssl.create_default_context(cafile=config.ca_file)
    except (ssl.SSLError, OSError):
        raise Refused(f"{config.ca_file}: is not a certificate in PEM form") from None
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    show_certificate(config, context)
    return context


def show_certificate(config: MqttConfig, context: ssl.SSLContext) -> None:
    """Load the certificate to show, where one is given."""
    if config.cert_file is None:
        return
    try:
        # a key with a passphrase would ask for it on the terminal
        context.load_cert_chain(config.cert_file, config.key_file, password=lambda: b"")
    except (ssl.SSLError, OSError):
        both = ", ".join(filter(None, (config.cert_file, config.key_file)))
        raise Refused(
            f"{both}: not a certificate in PEM form with its key (without passphrase)"
        ) from None


def refusal(broker: Broker, reason: Any) -> str:
    """Why the broker refuses us: ``reason`` is its answer's code."""
    text = str(reason).lower()
    if reason.value in _NOT_ALLOWED:
        user = broker.config.username
        who = f"user {user!r}" if user else "us without a user name"
        what = "user name and password" if user else "--username, --password-file"
        return f"refuses {who}: {text}. Check {what}."
    if reason.value == _BAD_CLIENT_ID:
        return f"refuses the client id {broker.client_id!r}. Choose another name with --gateway."
    return f"refuses the connection: {text}"


def failure(error: BaseException | None) -> str:
    """Why connecting failed."""
    if isinstance(error, ssl.SSLCertVerificationError):
        what = (error.verify_message or "it cannot be checked").rstrip(".")
        return f"its certificate is not accepted: {what}. Check --ca-file, and that --broker is the name in the certificate."
    if isinstance(error, ssl.SSLError):
        return f"TLS failed: {(error.reason or str(error)).lower().replace('_', ' ')}. Is this the port for TLS?"
    if isinstance(error, socket.gaierror):
        return "the host's name is not known. Check --broker and the network."
    if isinstance(error, TimeoutError):
        return "does not answer. Check --broker, the network and firewalls."
    if isinstance(error, ConnectionRefusedError):
        return "connection refused. Does it run, and is the port right?"
    text = getattr(error, "strerror", None) or str(error)
    return text[:1].lower() + text[1:] if not isinstance(error, Refused) else text
