import errno

import pytest

from udrl.file_remedies import file_remedy


@pytest.mark.parametrize(
    ("code", "remedy"),
    [
        (errno.ENOSPC, "free some disk space"),
        (errno.EDQUOT, "free some disk space"),
        (errno.EMFILE, "raise the limit of open files, e.g. ulimit -n 4096"),
        (errno.ENFILE, "raise the limit of open files, e.g. ulimit -n 4096"),
        (errno.EACCES, "choose another"),
        (None, "choose another"),
    ],
)
def test_remedy_fits_the_error(code: int | None, remedy: str) -> None:
    error = OSError("damaged") if code is None else OSError(code, "reason")
    assert file_remedy(error, "choose another") == remedy
