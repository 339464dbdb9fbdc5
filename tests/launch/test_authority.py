"""``udrl keys create``."""

import stat
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from click.testing import CliRunner
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from udrl.errors import ConfigError
from udrl_launch import authority
from udrl_launch.cli import cli
from udrl_proto.access import ROLES
from udrl_proto.credentials import load_credentials


def certificate(folder: Path, role: str) -> x509.Certificate:
    return x509.load_pem_x509_certificate((folder / role / "cert.pem").read_bytes())


def test_command_creates_keys_for_each_role(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "keys"
    result = CliRunner().invoke(cli, ["keys", "create", str(folder), "--days", "10"])
    assert result.exit_code == 0, result.output
    assert {path.name for path in folder.iterdir()} == {"ca", *ROLES}
    assert all(f"{folder / role}: " in result.output for role in ROLES)
    assert "stays here" in result.output
    now = datetime.now(UTC)
    for role in ROLES:
        load_credentials(folder, role)
        left = certificate(folder, role).not_valid_after_utc - now
        assert timedelta(days=9, hours=23) < left <= timedelta(days=10)


def test_private_keys_are_owner_only_and_distinct(tmp_path: Path) -> None:
    authority.create_keys(tmp_path / "keys")
    private = [*tmp_path.rglob("key.pem"), *tmp_path.rglob("ca.key")]
    assert len({path.read_bytes() for path in private}) == len(ROLES) + 1
    assert {stat.S_IMODE(path.stat().st_mode) for path in private} == {0o600}
    folders = [path for path in tmp_path.rglob("*") if path.is_dir()]
    assert {stat.S_IMODE(path.stat().st_mode) for path in folders} == {0o700}
    assert [path.parent.name for path in tmp_path.rglob("ca.key")] == ["ca"]


def test_only_the_replay_service_gets_a_server_certificate(tmp_path: Path) -> None:
    authority.create_keys(tmp_path, ["replay.example.org", "10.0.0.1", "fd00::1", "localhost"])
    for role in ROLES:
        found = certificate(tmp_path, role).extensions
        purposes = found.get_extension_for_class(x509.ExtendedKeyUsage).value
        assert (ExtendedKeyUsageOID.SERVER_AUTH in purposes) == (role == "replay")
        assert ExtendedKeyUsageOID.CLIENT_AUTH in purposes
        assert not found.get_extension_for_class(x509.BasicConstraints).value.ca
    names = (
        certificate(tmp_path, "replay")
        .extensions.get_extension_for_class(x509.SubjectAlternativeName)
        .value
    )
    assert [str(name.value) for name in names] == [
        "localhost", "127.0.0.1", "::1", "replay.example.org", "10.0.0.1", "fd00::1",
    ]  # fmt: skip


@pytest.mark.parametrize("host", ["", "a b", "tls/a:1", "a:1", "-a", "a..b", "ä", "a" * 64, "*.a"])
def test_invalid_host_is_rejected_and_nothing_is_written(host: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--host .*: expected a host name or an IP address"):
        authority.create_keys(tmp_path / "keys", [host])
    assert not (tmp_path / "keys").exists()


def test_existing_keys_are_not_overwritten(tmp_path: Path) -> None:
    authority.create_keys(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.pem")}
    with pytest.raises(ConfigError, match=r"is not empty.*never overwritten.*another folder"):
        authority.create_keys(tmp_path)
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*.pem")}


def test_empty_folders_may_exist_and_existing_keys_may_be_reused(tmp_path: Path) -> None:
    for role in ROLES:
        (tmp_path / role).mkdir()
    command = ["keys", "create", str(tmp_path), "--if-missing"]
    results = [CliRunner().invoke(cli, command) for _ in range(2)]
    assert [result.exit_code for result in results] == [0, 0]
    assert "already" in results[1].output
    (tmp_path / "actor" / "key.pem").unlink()
    incomplete = CliRunner().invoke(cli, command)
    assert isinstance(incomplete.exception, ConfigError)
    assert "is not empty" in str(incomplete.exception)


def test_reused_keys_must_be_valid_for_the_hosts(tmp_path: Path) -> None:
    authority.create_keys(tmp_path / "keys", ["10.0.0.1"])
    assert authority.has_keys(tmp_path / "keys", ["localhost", "10.0.0.1"])
    with pytest.raises(ConfigError, match=r"not valid for --host 10\.0\.0\.2; remove them"):
        authority.has_keys(tmp_path / "keys", ["10.0.0.1", "10.0.0.2"])
    authority.create_keys(tmp_path / "old", valid=timedelta(seconds=-1))
    with pytest.raises(ConfigError, match="expired"):
        authority.has_keys(tmp_path / "old")


def test_unwritable_folder_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "keys"):
        with pytest.raises(
            ConfigError, match=rf"cannot write keys to {folder}: (File exists|Not a directory)"
        ):
            authority.create_keys(folder)


def test_missing_extra_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "udrl_launch.authority")
    monkeypatch.delattr("udrl_launch.authority")
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(ConfigError, match=r'keys needs .*pip install "udrl\[secure\]"'):
        cli(["keys", "create", str(tmp_path / "keys")], standalone_mode=False)
