"""Invalid keys are reported with the remedy before a connection is opened."""

import json
import os
import shutil
import sys
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import pytest
import zenoh

from udrl.errors import ConfigError
from udrl_launch import authority
from udrl_proto.access import ROLES
from udrl_proto.credentials import CA, CERTIFICATE, KEY, load_credentials


@pytest.fixture
def folder(keys_dir: Path, tmp_path: Path) -> Path:
    """A copy of the actor's own folder."""
    return shutil.copytree(keys_dir / "actor", tmp_path / "mine")


@pytest.mark.parametrize("role", ROLES)
def test_shared_folder_and_own_folder_give_the_same_credentials(role: str, keys_dir: Path) -> None:
    assert load_credentials(keys_dir, role) == load_credentials(keys_dir / role, role)


def test_copied_folder_may_have_any_name(folder: Path) -> None:
    assert load_credentials(folder, "actor").key == folder / KEY


@pytest.mark.parametrize("name", [CA, CERTIFICATE, KEY])
def test_missing_file_is_reported(name: str, folder: Path) -> None:
    (folder / name).unlink()
    with pytest.raises(ConfigError, match=rf"{name}: No such file.*`udrl keys create`.*actor$"):
        load_credentials(folder, "actor")


@pytest.mark.parametrize("name", [CA, CERTIFICATE, KEY])
def test_unreadable_file_is_reported(name: str, folder: Path) -> None:
    (folder / name).unlink()
    (folder / name).mkdir()  # root can read files of any mode
    with pytest.raises(ConfigError, match=rf"{name}: Is a directory.*`udrl keys create`"):
        load_credentials(folder, "actor")


@pytest.mark.parametrize(
    "content", [b"", b"\xff\x00", b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n"]
)
@pytest.mark.parametrize(
    ("name", "kind"),
    [(CA, "a certificate"), (CERTIFICATE, "a certificate"), (KEY, "a private key")],
)
def test_damaged_file_is_reported(name: str, kind: str, content: bytes, folder: Path) -> None:
    (folder / name).write_bytes(content)
    with pytest.raises(ConfigError, match=rf"{name}: not {kind} in PEM.*copy it again"):
        load_credentials(folder, "actor")


def test_key_of_another_certificate_is_reported(folder: Path, keys_dir: Path) -> None:
    shutil.copy(keys_dir / "learner" / KEY, folder)
    with pytest.raises(ConfigError, match=r"key\.pem is not the key of .*cert\.pem; copy both"):
        load_credentials(folder, "actor")


def test_certificate_of_another_authority_is_reported(folder: Path, foreign_keys_dir: Path) -> None:
    shutil.copy(foreign_keys_dir / "actor" / CA, folder)
    with pytest.raises(ConfigError, match=r"cert\.pem was not issued by .*ca\.pem; copy both"):
        load_credentials(folder, "actor")


def test_certificate_of_another_role_is_reported(folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"for the role 'actor', expected 'learner'.*folder"):
        load_credentials(folder, "learner")


def _until_a_minute_ago(folder: Path) -> None:
    authority.create_keys(folder, valid=timedelta(minutes=-1))


def _from_tomorrow(folder: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(authority, "_CLOCKS_DIFFER", timedelta(days=-1))
        authority.create_keys(folder, valid=timedelta(days=2))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (_until_a_minute_ago, "expired at 20.*UTC; create new keys"),
        (_from_tomorrow, "valid from 20.*clock here says 20.*correct the clock"),
    ],
)
def test_certificate_outside_its_validity_period_is_reported(
    make: Callable[[Path], None], message: str, tmp_path: Path
) -> None:
    make(tmp_path)
    with pytest.raises(ConfigError, match=rf"ca\.pem.*{message}"):
        load_credentials(tmp_path, "actor")


def test_key_readable_by_others_is_warned_of(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    load_credentials(folder, "actor")
    assert caplog.messages == []
    (folder / KEY).chmod(0o640)
    load_credentials(folder, "actor")
    assert caplog.messages == [f"{folder / KEY} can be read by others; chmod 600 it"]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can own the file")
@pytest.mark.parametrize(("mode", "warnings"), [(0o640, 0), (0o644, 1), (0o660, 1)])
def test_key_owned_by_root_may_be_group_readable(
    mode: int,
    warnings: int,
    folder: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (folder / KEY).chmod(mode)
    monkeypatch.setattr(os, "geteuid", lambda: 10001)
    load_credentials(folder, "actor")
    assert len(caplog.messages) == warnings


def test_settings_contain_paths_and_no_secrets(folder: Path) -> None:
    config = zenoh.Config()
    for name, value in load_credentials(folder, "actor").settings().items():
        config.insert_json5(name, json.dumps(value))
    assert str(folder / KEY) in str(config)
    assert (folder / KEY).read_text().splitlines()[1] not in str(config)


def test_missing_extra_is_reported(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "udrl_proto.certificates", raising=False)
    monkeypatch.delattr("udrl_proto.certificates", raising=False)
    monkeypatch.setitem(sys.modules, "cryptography.exceptions", None)
    with pytest.raises(ConfigError, match=r'--keys needs .*pip install "udrl\[secure\]"'):
        load_credentials(folder, "actor")
