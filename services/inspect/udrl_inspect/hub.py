"""Agents on the Hugging Face Hub."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from udrl.errors import ConfigError, InvalidData, Unreachable
from udrl.folder import FILES, MAX_BYTES

#: How addresses of agents on the Hub begin: ``hf://OWNER/NAME`` or ``hf://OWNER/NAME@REVISION``.
HUB_SCHEME = "hf://"
#: Seconds without a response after which a request has failed.
_TIMEOUT_S = 60.0


def upload(folder: Path, repo_id: str, *, public: bool) -> str:
    """Upload all files of a folder to a model repository in one commit; return its URL.

    The token is that of huggingface_hub: ``HF_TOKEN``, or the one of ``hf auth login``.

    Args:
        folder: the files.
        repo_id: ``OWNER/NAME``. It is created if it does not exist.
        public: whether everyone may read it.

    Raises:
        ConfigError: the extra is not installed, the Hub refuses, or the repository exists with
            another visibility.
        Unreachable: the Hub does not respond.
    """
    with _hub_errors(repo_id):
        from huggingface_hub import CommitOperationAdd, HfApi, get_session

        get_session().timeout = _TIMEOUT_S
        api = HfApi()
        repo_id = api.create_repo(repo_id, private=not public, exist_ok=True).repo_id
        if api.model_info(repo_id, timeout=_TIMEOUT_S).private == public:
            raise ConfigError(
                f"{repo_id} exists and is private; leave --public out, or change its visibility on "
                f"the Hub"
                if public
                else f"{repo_id} exists and is public; give --public to upload to it"
            )
        files = sorted(path for path in folder.iterdir() if path.is_file())
        commit = api.create_commit(
            repo_id,
            [CommitOperationAdd(path.name, path.read_bytes()) for path in files],
            commit_message="Upload an agent exported by udrl",
        )
        return str(commit.repo_url)


def download(address: str) -> Path:
    """Download the files of an exported agent, and return their folder in the Hub's cache.

    Args:
        address: ``hf://OWNER/NAME`` or ``hf://OWNER/NAME@REVISION``.

    Raises:
        ConfigError: the extra is not installed, or there is no such repository or no access to it.
        InvalidData: a file is too large.
        Unreachable: the Hub does not respond.
    """
    repo_id, _, revision = address.removeprefix(HUB_SCHEME).partition("@")
    with _hub_errors(repo_id):
        from huggingface_hub import HfApi

        api = HfApi()
        info = api.model_info(
            repo_id, revision=revision or None, files_metadata=True, timeout=_TIMEOUT_S
        )
        sizes = {file.rfilename: file.size for file in info.siblings or ()}
        names = [name for name in FILES if name in sizes]
        if not names:
            raise ConfigError(
                f"{address} has no {FILES[0]}; name a repository that udrl export --hub wrote"
            )
        for name in names:
            size = sizes[name]
            if size is None or size > MAX_BYTES:
                raise InvalidData(
                    f"{address}: {name} has {size} bytes, at most {MAX_BYTES:,} are accepted; "
                    f"name a repository that udrl export --hub wrote"
                )
        # All of one commit, even if another one is uploaded during the download.
        paths = [api.hf_hub_download(repo_id, name, revision=info.sha) for name in names]
        return Path(paths[0]).parent


@contextmanager
def _hub_errors(repo_id: str) -> Iterator[None]:
    """Raise errors of huggingface_hub as our own."""
    try:
        from huggingface_hub.errors import (  # type: ignore[attr-defined]
            HfHubHTTPError,
            HFValidationError,
            HTTPError,
            LocalTokenNotFoundError,
        )
    except ModuleNotFoundError as error:
        raise ConfigError(
            'the Hugging Face Hub needs huggingface_hub; install it with: pip install "udrl[hub]"'
        ) from error
    try:
        yield
    except HFValidationError as error:
        raise ConfigError(f"{repo_id}: {error}; expected OWNER/NAME") from error
    except (HfHubHTTPError, LocalTokenNotFoundError) as error:
        raise ConfigError(
            f"the Hub refused {repo_id}: {error}; check the name, and log in with: hf auth login"
        ) from error
    except (HTTPError, OSError) as error:
        raise Unreachable(
            f"the Hugging Face Hub did not respond for {repo_id}: {error}; check the network"
        ) from error
