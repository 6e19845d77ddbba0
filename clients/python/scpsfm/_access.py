"""Where a server is, who calls, and whom to trust: the same for both clients."""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import grpc

from .errors import InvalidArgument, Violation

__all__ = ["Access"]

_MAX_MESSAGE_BYTES = 64 << 20
"""Largest answer that is taken: interim weights of the most tracks that any server allows are below it."""

_OPTIONS: tuple[tuple[str, int], ...] = (
    ("grpc.max_receive_message_length", _MAX_MESSAGE_BYTES),
    ("grpc.max_send_message_length", -1),
    # A silent connection is asked this often whether it lives, so that a watch of a long job notices a lost server.
    ("grpc.keepalive_time_ms", 20_000),
    ("grpc.keepalive_timeout_ms", 10_000),
    ("grpc.http2.max_pings_without_data", 0),
    # How soon a lost server is found again; gRPC itself waits for up to two minutes between its tries.
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 1_000),
    ("grpc.max_reconnect_backoff_ms", 2_000),
)


def _wrong(name: str, what: str) -> InvalidArgument:
    return InvalidArgument(f"{name}: {what}", reason="INVALID_ARGUMENT", violations=[Violation(name, what)])


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _pem(name: str, given: str | PathLike[str] | bytes | None) -> bytes | None:
    """The bytes of a PEM file, or those that were given."""
    if given is None or isinstance(given, bytes):
        return given
    try:
        return Path(given).read_bytes()
    except OSError as error:
        raise _wrong(name, f"{given}: {error.strerror}") from None


@dataclass(frozen=True)
class Access:
    """How a server is reached."""

    target: str
    """As gRPC takes it: HOST:PORT."""

    secure: bool
    metadata: tuple[tuple[str, str], ...] = field(repr=False)
    """What every call carries; the key is in it."""

    tenant: str | None
    options: tuple[tuple[str, Any], ...]
    root: bytes | None = field(default=None, repr=False)
    certificate: bytes | None = field(default=None, repr=False)
    private_key: bytes | None = field(default=None, repr=False)

    @property
    def parent(self) -> str:
        """The tenant as requests name it; empty: that of the key."""
        return "" if self.tenant is None else f"tenants/{self.tenant}"

    def credentials(self) -> grpc.ChannelCredentials | None:
        """What a channel is encrypted with; `None`: nothing."""
        if not self.secure:
            return None
        return grpc.ssl_channel_credentials(self.root, self.private_key, self.certificate)

    @classmethod
    def of(
        cls,
        address: str,
        *,
        api_key: str | None,
        tenant: str | None,
        tls_ca: str | PathLike[str] | bytes | None,
        tls_cert: str | PathLike[str] | bytes | None,
        tls_key: str | PathLike[str] | bytes | None,
        tls_server_name: str | None,
        plaintext_keys: bool,
        options: Sequence[tuple[str, Any]],
    ) -> Access:
        """Reads and checks everything.

        Raises:
            InvalidArgument: What cannot be used, by the name of the argument.

        """
        if "@" in address:
            # Not repeated: what stands there may be a password.
            raise _wrong("address", "holds a user or a password (`@`); an API key is given as api_key")
        wants_tls = any(given is not None for given in (tls_ca, tls_cert, tls_key, tls_server_name))
        scheme, separator, _ = address.partition("://")
        if separator and scheme not in ("http", "https"):
            raise _wrong("address", f"{address!r} is none of HOST:PORT, http://HOST:PORT and https://HOST:PORT")
        secure = scheme == "https" if separator else wants_tls
        try:
            parts = urlsplit(address if separator else f"//{address}")
            host, port = parts.hostname or "", parts.port
        except ValueError:
            host, port, parts = "", None, urlsplit("")
        if not host or parts.path.strip("/") or parts.query or parts.fragment:
            raise _wrong("address", f"{address!r} is none of HOST:PORT, http://HOST:PORT and https://HOST:PORT")
        if port is None and not separator:
            raise _wrong("address", f"{address!r} has no port")
        if wants_tls and not secure:
            raise _wrong("address", "tls_ca, tls_cert, tls_key and tls_server_name need https://")
        if (tls_cert is None) != (tls_key is None):
            raise _wrong("tls_cert", "tls_cert and tls_key are given together, or neither")
        if api_key is None:
            api_key = os.environ.get("SCPSFM_API_KEY") or None
        if tenant is None:
            tenant = os.environ.get("SCPSFM_TENANT") or None
        metadata: tuple[tuple[str, str], ...] = ()
        if api_key is not None:
            api_key = api_key.strip()
            # The key itself is not repeated.
            if not api_key or not api_key.isascii() or not api_key.isprintable() or " " in api_key:
                raise _wrong("api_key", "holds characters that no key has, or is empty")
            if not secure and not plaintext_keys and not _is_loopback(host):
                raise _wrong(
                    "api_key",
                    f"would travel readable to {host}: use https://, or plaintext_keys=True where nobody can listen in",
                )
            metadata = (("authorization", f"Bearer {api_key}"),)
        chosen: list[tuple[str, Any]] = list(_OPTIONS)
        if _is_loopback(host):
            chosen.append(("grpc.enable_http_proxy", 0))
        if tls_server_name is not None:
            chosen.append(("grpc.ssl_target_name_override", tls_server_name))
        bracketed = f"[{host}]" if ":" in host else host
        return cls(
            target=f"{bracketed}:{port if port is not None else 443 if secure else 80}",
            secure=secure,
            metadata=metadata,
            tenant=tenant,
            options=(*chosen, *options),
            root=_pem("tls_ca", tls_ca),
            certificate=_pem("tls_cert", tls_cert),
            private_key=_pem("tls_key", tls_key),
        )
