"""HTTPS, with a certificate of the test's own."""

from __future__ import annotations

import datetime
import ipaddress
import ssl
from pathlib import Path

import httpx
import pytest
from api_service import running
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from services.api import create_app, create_server
from services.domain.errors import InvalidRequest
from services.settings import Settings
from services.store.sql import SqlStore


def certificate(folder: Path) -> tuple[Path, Path]:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "test")])
    today = datetime.datetime.now(datetime.UTC)
    names = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
    made = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(today - datetime.timedelta(days=1))
        .not_valid_after(today + datetime.timedelta(days=1))
        .add_extension(names, critical=False)
        .sign(key, hashes.SHA256())
    )
    cert_file, key_file = folder / "cert.pem", folder / "key.pem"
    cert_file.write_bytes(made.public_bytes(serialization.Encoding.PEM))
    no_password = serialization.NoEncryption()
    pem = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, no_password)
    key_file.write_bytes(pem)
    return cert_file, key_file


def test_https(tmp_path: Path) -> None:
    cert_file, key_file = certificate(tmp_path)
    files = (f"tls_cert_file={cert_file}", f"tls_key_file={key_file}")
    with running(f"sqlite:///{tmp_path}/store.db", *files) as service:
        assert service.url.startswith("https://")
        with httpx.Client(base_url=service.url, verify=ssl.create_default_context(cafile=str(cert_file))) as http:
            answer = http.get("/v1/jobs")
            assert answer.status_code == 200
            assert "max-age" in answer.headers["strict-transport-security"]
        with pytest.raises(httpx.TransportError):
            httpx.get(service.url.replace("https", "http") + "/healthz")


def test_files_that_cannot_be_used(tmp_path: Path) -> None:
    cert_file, key_file = certificate(tmp_path)
    with pytest.raises(ValueError, match="go together"):
        Settings(tls_cert_file=cert_file)
    store = SqlStore(f"sqlite:///{tmp_path}/store.db")
    for cert, key in ((tmp_path / "none.pem", key_file), (key_file, cert_file)):
        settings = Settings(port=0, tls_cert_file=cert, tls_key_file=key)
        with pytest.raises(InvalidRequest, match="VIPE_TLS_CERT_FILE"):
            create_server(create_app(store, settings), settings)
    store.close()
