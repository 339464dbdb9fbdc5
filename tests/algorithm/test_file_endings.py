from pathlib import Path

import pytest

from udrl.errors import ConfigError
from udrl.file_endings import check_ending

ENDINGS = (".png", ".svg", ".pdf")


@pytest.mark.parametrize("name", ["a.png", "a.svg", "a.b.pdf"])
def test_supported_endings_are_accepted(name: str) -> None:
    check_ending(Path(name), ENDINGS)


@pytest.mark.parametrize("name", ["a", "a.PNG", "a.png.gz", ".png"])
def test_other_endings_are_rejected(name: str) -> None:
    with pytest.raises(ConfigError) as raised:
        check_ending(Path(name), ENDINGS)
    assert str(raised.value) == f"{name}: expected a name that ends with .png, .svg or .pdf"


@pytest.mark.parametrize(
    ("endings", "named"), [((".onnx",), ".onnx"), ((".mp4", ".gif"), ".mp4 or .gif")]
)
def test_message_names_the_endings(endings: tuple[str, ...], named: str) -> None:
    with pytest.raises(ConfigError, match=f"ends with {named}$"):
        check_ending(Path("a.txt"), endings)
