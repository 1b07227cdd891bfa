"""A flow's own certificate authority, and a certificate for each machine that may take part.

A folder holds `ca.crt`, `ca.key` and for each machine `NAME.crt` and `NAME.key`, all readable by their owner only. A
machine needs `ca.crt` and its own two; `ca.key` makes new certificates and stays where it was made.
"""

import datetime
import ipaddress
import os
import re
import secrets
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from caneflow.messages import NAME, NAME_RULE
from caneflow.runtime.errors import DataflowError

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

AUTHORITY = "ca"
OBSERVER = "observer"  # the common name of everybody who may look and not touch
ROUTER = "router"  # that of a router which passes on for all machines
AUTHORITY_DAYS = 3650
MACHINE_DAYS = 730
SKEW = datetime.timedelta(days=1)  # a machine without a clock battery may be behind


class Credentials(NamedTuple):
    """What a machine shows, and by whom it knows the others."""

    authority: Path
    certificate: Path
    key: Path


@dataclass(frozen=True, kw_only=True)
class Listed:
    """One certificate of a folder."""

    name: str
    role: str  # authority, machine, observer
    expires: datetime.datetime


def credentials(folder: Path, name: str) -> Credentials | None:
    """Those of the machine `name`; None when `folder` holds none of it.

    Raises DataflowError when they are there in part, or when others may read the key.
    """
    found = Credentials(folder / f"{AUTHORITY}.crt", folder / f"{name}.crt", folder / f"{name}.key")
    missing = [path for path in found if not path.is_file()]
    if len(missing) == len(found):
        return None
    if missing:
        raise DataflowError(f"{missing[0]}: is missing; `caneflow keys add {name}` makes it, where {AUTHORITY}.key is")
    if found.key.stat().st_mode & 0o077:
        raise DataflowError(f"{found.key}: others may read it; chmod 600 {found.key}")
    return found


def make_authority(folder: Path) -> Path:
    """Start a flow's own authority in `folder`; raises DataflowError when there is one."""
    certificate = folder / f"{AUTHORITY}.crt"
    if certificate.exists() or (folder / f"{AUTHORITY}.key").exists():
        raise DataflowError(f"{certificate}: already exists; a new authority would make every existing key invalid")
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    key = _new_key()
    name = _name(f"caneflow {secrets.token_hex(4)}")  # two authorities are never mistaken for each other
    _store(folder, AUTHORITY, _signed(name, key, name, key, AUTHORITY_DAYS, authority=True), key)
    return certificate


def make_certificate(
    folder: Path,
    name: str,
    *,
    observer: bool = False,
    days: int = MACHINE_DAYS,
    anew: bool = False,
    addresses: Sequence[str] = (),
) -> Path:
    """Make the certificate of a machine, or of an observer; raises DataflowError when it cannot be.

    `anew`: in the place of one that is there. `addresses`: IP addresses and host names by which browsers come to it.
    """
    if not re.fullmatch(NAME.pattern, name):
        raise DataflowError(f"{name!r} not a valid name; expected {NAME_RULE}")
    if name in (AUTHORITY, OBSERVER):
        raise DataflowError(f"{name!r} is taken; call the {'observer' if observer else 'machine'} otherwise")
    certificate = folder / f"{name}.crt"
    if certificate.exists() and not anew:
        raise DataflowError(f"{certificate}: is there; --anew makes another")
    authority, authority_key = _authority(folder)
    key = _new_key()
    subject = _name(OBSERVER, unit=name) if observer else _name(name)
    _store(folder, name, _signed(subject, key, authority.subject, authority_key, days, addresses=addresses), key)
    return certificate


def certificates(folder: Path) -> Iterator[Listed]:
    """What `folder` holds, by name."""
    from cryptography import x509
    from cryptography.x509.oid import NameOID

    for path in sorted(folder.glob("*.crt")):
        try:
            certificate = x509.load_pem_x509_certificate(path.read_bytes())
        except ValueError as error:
            raise DataflowError(f"{path}: not a certificate: {error}") from error
        common = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value
        role = "authority" if path.stem == AUTHORITY else "observer" if common == OBSERVER else "machine"
        yield Listed(name=path.stem, role=role, expires=certificate.not_valid_after_utc)


def _authority(folder: Path) -> "tuple[x509.Certificate, ec.EllipticCurvePrivateKey]":
    from cryptography import x509
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    certificate, key = folder / f"{AUTHORITY}.crt", folder / f"{AUTHORITY}.key"
    for path in (certificate, key):
        if not path.is_file():
            raise DataflowError(f"{path}: is missing; `caneflow keys init` starts a flow's authority")
    loaded = serialization.load_pem_private_key(key.read_bytes(), None)
    if not isinstance(loaded, ec.EllipticCurvePrivateKey):
        raise DataflowError(f"{key}: not a key of an elliptic curve, as `caneflow keys init` makes them")
    return x509.load_pem_x509_certificate(certificate.read_bytes()), loaded


def _new_key() -> "ec.EllipticCurvePrivateKey":
    from cryptography.hazmat.primitives.asymmetric import ec

    return ec.generate_private_key(ec.SECP256R1())


def _name(common: str, unit: str | None = None) -> "x509.Name":
    from cryptography import x509
    from cryptography.x509.oid import NameOID

    parts = [x509.NameAttribute(NameOID.COMMON_NAME, common)]
    if unit is not None:
        parts.append(x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, unit))
    return x509.Name(parts)


def _signed(
    subject: "x509.Name",
    key: "ec.EllipticCurvePrivateKey",
    issuer: "x509.Name",
    issuer_key: "ec.EllipticCurvePrivateKey",
    days: int,
    *,
    authority: bool = False,
    addresses: Sequence[str] = (),
) -> "x509.Certificate":
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

    now = datetime.datetime.now(datetime.UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - SKEW)
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=authority, path_length=0 if authority else None), critical=True)
    )
    if not authority:
        # Who a machine is stands in its common name, which access control goes by, and not in its address, which
        # changes. TLS wants an alternative name all the same.
        common = str(subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)
        builder = builder.add_extension(
            x509.SubjectAlternativeName([x509.DNSName(common.replace("_", "-")), *map(_alternative, addresses)]),
            critical=False,
        ).add_extension(
            x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]), critical=False
        )
    return builder.sign(issuer_key, hashes.SHA256())


def _alternative(address: str) -> "x509.GeneralName":
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        pass
    if not re.fullmatch(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?", address):
        raise DataflowError(f"{address!r}: not an address; expected e.g. 192.168.1.5 or gateway.local")
    return x509.DNSName(address)


def _store(folder: Path, name: str, certificate: "x509.Certificate", key: "ec.EllipticCurvePrivateKey") -> None:
    from cryptography.hazmat.primitives import serialization

    form, unencrypted = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    _write(folder / f"{name}.key", key.private_bytes(serialization.Encoding.PEM, form, unencrypted))
    _write(folder / f"{name}.crt", certificate.public_bytes(serialization.Encoding.PEM))


def _write(path: Path, content: bytes) -> None:
    """Write a file that only its owner ever could read; whole or not at all."""
    fresh = path.with_name(f".{path.name}.new")
    fresh.unlink(missing_ok=True)
    with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(content)
    fresh.replace(path)
