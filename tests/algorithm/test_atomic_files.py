"""Atomic writes: an interrupted write leaves the old file."""

from pathlib import Path

import pytest

from udrl.atomic_files import replacing, write_atomically


def test_content_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    for content in (b"old", b"new"):
        write_atomically(path, content)
        assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]


def test_old_content_remains_until_the_new_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    write_atomically(path, b"old")
    with replacing(path) as unfinished:
        unfinished.write_bytes(b"new")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"


def test_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    write_atomically(path, b"old")

    def fail() -> None:
        with replacing(path) as unfinished:
            unfinished.write_bytes(b"ne")
            raise OSError("no space left")

    with pytest.raises(OSError, match="no space left"):
        fail()
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    write_atomically(path, b"new")
    assert path.read_bytes() == b"new"
