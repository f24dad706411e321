"""A service starts quickly, and without TLS it serves only this machine."""

from __future__ import annotations

import datetime
import ipaddress
import re
from pathlib import Path

import httpx
import psutil
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from benchmarks import service as service_benchmark
from cavmarl.client import Client
from cavmarl.core.errors import ServiceError
from cavmarl.service.server import check_transport
from tests.support.service import running_service

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.5", "example.org"])
def test_an_address_for_other_machines_is_refused_without_tls(host: str) -> None:
    with pytest.raises(ServiceError, match="--certificate and --key"):
        check_transport(host, None, None)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "::1", "localhost"])
def test_a_loopback_address_needs_no_tls(host: str) -> None:
    check_transport(host, None, None)


def test_a_certificate_without_a_key_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ServiceError, match="both"):
        check_transport("127.0.0.1", tmp_path / "cert.pem", None)
    with pytest.raises(ServiceError, match="does not exist"):
        check_transport("0.0.0.0", tmp_path / "cert.pem", tmp_path / "key.pem")


def test_a_client_checks_the_certificate_of_the_service(tmp_path: Path) -> None:
    certificate, key = make_certificate(tmp_path)
    options = ("--certificate", str(certificate), "--key", str(key))
    with running_service(tmp_path / "store.sqlite", *options) as service:
        assert service.url.startswith("https://")
        with Client(service.url, service.secret, verify=str(certificate)) as client:
            assert client.get("/health")["status"] == "ok"
        with (
            Client(service.url, service.secret) as client,
            pytest.raises(ServiceError, match="cannot be reached"),
        ):
            client.get("/health")


def test_the_service_starts_without_kernels(tmp_path: Path) -> None:
    """Check that the process has not loaded compilers and learning libraries, which are slow."""
    with running_service(tmp_path / "store.sqlite", fresh=True) as service:
        assert httpx.get(f"{service.url}/v1/health").status_code == 200
        mapped = {
            Path(found.path).name for found in psutil.Process(service.process.pid).memory_maps()
        }
    assert any("pydantic" in name for name in mapped)
    heavy = ("llvmlite", "_dispatcher", "torch", "pyarrow", "sumo")
    assert {name for name in mapped if any(word in name for word in heavy)} == set()


def test_the_benchmark_of_the_service_measures_and_its_replay_gives_the_same_state() -> None:
    found = service_benchmark.measure(nodes=200, requests=60, seconds=2, hours=0.1)
    assert found.holds
    assert found.facts["churn"]["sessions hosted that are not active"] == 0
    assert found.facts["churn"]["events"] > 300
    assert 0.0 < found.facts["selection_ms"]["p50"] <= found.facts["selection_ms"]["p99"]
    assert found.facts["beats_share"] > 0.0


def test_the_service_itself_imports_no_http_client() -> None:
    """Check that the service cannot connect to an address in a request; only its nodes use HTTP."""
    for path in (ROOT / "cavmarl" / "service").glob("*.py"):
        text = path.read_text(encoding="utf-8")
        calls = re.search(
            r"import (httpx|requests|urllib\.request|http\.client)|cavmarl\.client\.c", text
        )
        assert (calls is not None) == (path.name == "node_link.py"), path.name


def make_certificate(folder: Path) -> tuple[Path, Path]:
    """Create a self-signed certificate for 127.0.0.1."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "cavmarl")])
    now = datetime.datetime.now(datetime.UTC)
    address = x509.IPAddress(ipaddress.ip_address("127.0.0.1"))
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(hours=1))
        .add_extension(x509.SubjectAlternativeName([address]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, hashes.SHA256())
    )
    paths = folder / "certificate.pem", folder / "key.pem"
    paths[0].write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    paths[1].write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )
    paths[1].chmod(0o600)
    return paths
