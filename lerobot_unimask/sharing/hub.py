"""The Hub in one place: what is pushed, in one commit; what is fetched, and checked; errors that say what to do.

The client is huggingface_hub, so `HF_ENDPOINT`, `HF_TOKEN`, `HF_HUB_OFFLINE` and its cache work as everywhere else.
"""

import hashlib
import json
import re
import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import httpx
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, constants, get_token, snapshot_download
from huggingface_hub.constants import CONFIG_NAME, SAFETENSORS_SINGLE_FILE
from huggingface_hub.errors import (
    EntryNotFoundError,
    FileMetadataError,
    GatedRepoError,
    HfHubHTTPError,
    HFValidationError,
    LocalEntryNotFoundError,
    OfflineModeIsEnabled,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)
from huggingface_hub.file_download import repo_folder_name
from lerobot.datasets.utils import get_safe_version
from lerobot.utils.constants import HF_LEROBOT_HUB_CACHE

from lerobot_unimask.data.checkpoints import last_checkpoint
from lerobot_unimask.pretrained import FOLDERS
from lerobot_unimask.records import read_json


class HubError(OSError):
    """One sentence: what is missing or went wrong, and what to do about it."""


class Origin(NamedTuple):
    """Where a policy was loaded from: a repository and its commit, or a folder, which has none."""

    repository: str
    revision: str | None


def find_policy(name_or_path: str | Path, *, revision: str | None = None, **download: Any) -> Path:
    """The folder of a policy's files: of a checkpoint, of a training's last one, of a policy that comes with the
    package, or of what `fetch` gets."""
    folder = Path(name_or_path)
    if folder.is_dir():
        return last_checkpoint(folder)
    return FOLDERS.get(str(name_or_path)) or fetch(str(name_or_path), revision=revision, **download)


def fetch(repo_id: str, *, revision: str | None = None, **download: Any) -> Path:
    """The folder of a policy's files, all of one commit, from the cache or the Hub.

    Args:
        revision: a branch, tag or commit; None: the newest.
        download: further arguments of `snapshot_download`.

    Raises:
        HubError: anything is missing, cannot be reached, or does not have the content that its hash names; of what
            failed nothing stays in the cache. Also where loading it would run code that the repository names.
    """
    with pull_errors(repo_id, revision):
        # The processors too: LeRobot's commands read them later, and may be offline then.
        patterns: dict[str, Any] = {"allow_patterns": ["*.json", "*.safetensors"], "ignore_patterns": ["*/*"]}
        folder = Path(snapshot_download(repo_id, revision=revision, **patterns, **download))
        for name in (CONFIG_NAME, SAFETENSORS_SINGLE_FILE):
            if not (folder / name).exists():
                raise LocalEntryNotFoundError(name) if constants.is_offline_mode() else EntryNotFoundError(name)
    damaged = [path for path in sorted(folder.iterdir()) if _damaged(path)]
    for path in damaged:
        path.resolve().unlink(missing_ok=True)
        path.unlink(missing_ok=True)
    if damaged:
        raise HubError(
            f"{', '.join(path.name for path in damaged)} of {repo_id} arrived damaged: the content is not that of the "
            "hash that the Hub names; it has been removed from the cache, so run this again to fetch it anew."
        )
    _check_processors(folder, repo_id)
    return folder


def commit_of(folder: Path) -> str | None:
    """The commit that a folder of the client's cache is of; None for any other folder."""
    return folder.name if folder.parent.name == "snapshots" and re.fullmatch("[0-9a-f]{40}", folder.name) else None


def _damaged(path: Path) -> bool:
    """The client checks only a download's length. Its cache names each file by its hash: sha256, or git's sha1."""
    blob = path.resolve()
    digest = {40: hashlib.sha1, 64: hashlib.sha256}.get(len(blob.name))
    if digest is None or not re.fullmatch("[0-9a-f]+", blob.name):  # no cache of hashes, as on a disk without links
        return False
    data = blob.read_bytes()
    return digest((b"blob %d\0" % len(data) if len(blob.name) == 40 else b"") + data).hexdigest() != blob.name


def _check_processors(folder: Path, repo_id: str) -> None:
    """LeRobot imports and calls whatever a step names as its `class`; its own steps go by registered names."""
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        steps = json.loads((folder / name).read_text())["steps"] if (folder / name).exists() else []
        if any("registry_name" not in step for step in steps):
            raise HubError(f"{name} of {repo_id} names code to run; a unimask policy has only LeRobot's own steps.")


@contextmanager
def pull_errors(repo_id: str, revision: str | None, kind: str = "policy") -> Iterator[None]:
    """
    Args:
        kind: what is pulled, "policy" or "dataset".

    Raises:
        HubError: says what was asked for, and what the Hub answered or that it did not.
    """
    try:
        yield
    except HFValidationError as error:
        raise HubError(
            f"{repo_id!r} is neither a folder on this machine nor the name of a repository on the Hub, ME/NAME."
        ) from error
    except GatedRepoError as error:
        page = f"{constants.ENDPOINT}/{'datasets/' if kind == 'dataset' else ''}{repo_id}"
        raise HubError(f"{repo_id} is gated: its owner has to let you in, at {page}.") from error
    except RepositoryNotFoundError as error:
        raise HubError(
            f"The Hub at {constants.ENDPOINT} has no {kind} {repo_id} that you may read: check the name and, if it is "
            "private, log in with `hf auth login` or set HF_TOKEN."
        ) from error
    except RevisionNotFoundError as error:
        raise HubError(f"{repo_id} has no revision {revision!r} on the Hub; `main` is its newest.") from error
    except LocalEntryNotFoundError as error:
        if constants.is_offline_mode():
            reason = "HF_HUB_OFFLINE=1 forbids asking the Hub for it: run this once without HF_HUB_OFFLINE."
        else:
            reason = _refusal(_answer(error))
        raise HubError(f"The {kind} {repo_id} has not been pulled to this machine, and {reason}") from error
    except EntryNotFoundError as error:
        raise HubError(
            f"{repo_id} holds no {error}{f' at revision {revision!r}' if revision else ''}: it is not a policy, or its "
            f"first push has not been finished; `unimask push --policy.path=DIR --repo_id={repo_id}` does so."
        ) from error
    except (HfHubHTTPError, FileMetadataError, json.JSONDecodeError, httpx.ConnectError) as error:
        raise HubError(f"{repo_id} cannot be pulled: {_refusal(error)}") from error
    except (httpx.HTTPError, OSError) as error:
        raise HubError(
            f"The download of {repo_id} broke off ({_first_line(error)}): no file of which a part is missing has been "
            "kept, so run this again."
        ) from error


def pulled_version(repo_id: str, version: Any, **kwargs: Any) -> str:
    """In place of LeRobot's `get_safe_version`: offline, the version that is asked for, if it has been pulled."""
    if not constants.is_offline_mode():
        with pull_errors(repo_id, str(version), "dataset"):
            return get_safe_version(repo_id, version, **kwargs)
    place = HF_LEROBOT_HUB_CACHE / repo_folder_name(repo_id=repo_id, repo_type="dataset") / "refs" / str(version)
    if not place.exists():
        raise HubError(
            f"The dataset {repo_id} has not been pulled to this machine, and HF_HUB_OFFLINE=1 forbids asking the Hub "
            "for it: run this once without HF_HUB_OFFLINE, or give its folder with --dataset.root."
        )
    return str(version)


def push_policy(
    folder: Path,
    repo_id: str,
    card: Mapping[str, bytes],
    *,
    private: bool | None = None,
    saved: Path | None = None,
) -> str:
    """Push a saved policy with its card: config, weights, processors and train config in one commit.

    Args:
        folder: place of the files, as `save_pretrained` or lerobot-train writes them.
        card: file name -> content, as `cards.policy_card` writes it.
        private: whether to create the repository as a private one.
        saved: folder where the user finds it, if `folder` is a passing one.

    Returns:
        The repository's address.

    Raises:
        HubError: it could not be pushed. Says what of it is to be seen on the Hub then: nothing.
        ValueError: a file is a link that leads out of the folder.
    """
    files = {path.name: path for pattern in ("*.json", "*.safetensors") for path in sorted(folder.glob(pattern))}
    # A checkpoint in the client's cache is made of links into the cache's own repository.
    _check_links(files, folder.parent.parent if commit_of(folder) else folder)
    return _push(
        {**files, **card},
        repo_id,
        kind="model",
        private=private,
        message="Upload policy: weights, config, processors, train config and card",
        again=f"unimask push --policy.path={shlex.quote(str(saved or folder))} --repo_id={repo_id}",
    )


def push_dataset(root: Path, repo_id: str, card: Mapping[str, bytes], *, private: bool | None = None) -> str:
    """Push a LeRobotDataset with its card in one commit, and tag that with the version that LeRobot asks for.

    The repository then holds these files and no others. See `push_policy` for the rest.

    Raises:
        ValueError: a file is a link that leads out of the folder.
    """
    paths = {path.relative_to(root): path for path in sorted(root.rglob("*")) if path.is_file()}
    files = {
        path.as_posix(): place for path, place in paths.items() if not any(part.startswith(".") for part in path.parts)
    }
    _check_links(files, root)
    return _push(
        {**files, **card},
        repo_id,
        kind="dataset",
        private=private,
        message="Upload dataset and card",
        again=f"unimask push --dataset.root={shlex.quote(str(root))} --repo_id={repo_id}",
        tag=read_json(root / "meta" / "info.json")["codebase_version"],
    )


def _check_links(files: Mapping[str, Path], folder: Path) -> None:
    for path in files.values():
        if not path.resolve().is_relative_to(folder.resolve()):
            raise ValueError(f"{path} is a link out of its folder, so it is not pushed: put the file itself there.")


def _push(
    files: Mapping[str, Path | bytes],
    repo_id: str,
    *,
    kind: str,
    private: bool | None,
    message: str,
    again: str,
    tag: str | None = None,
) -> str:
    """Make one commit of all files; with a tag, which then names it, the repository holds no others."""
    api = HfApi()
    with _push_errors(repo_id, again, "nothing of this push is to be seen there"):
        url = api.create_repo(repo_id, repo_type=kind, private=private, exist_ok=True)
        repo_id = url.repo_id
        # The client leaves out what the head has already, so the commit is whole only on this head.
        head = api.repo_info(repo_id, repo_type=kind).sha
        operations: list[Any] = [CommitOperationAdd(path, content) for path, content in files.items()]
        if tag is not None:
            there = api.list_repo_files(repo_id, repo_type=kind, revision=head)
            operations += [CommitOperationDelete(path) for path in there if path not in {*files, ".gitattributes"}]
        commit = api.create_commit(repo_id, operations, commit_message=message, repo_type=kind, parent_commit=head)
    if tag is not None:
        whole = (
            f"its {len(files)} files are there, in commit {commit.oid[:8]}, but not the tag {tag}, which LeRobot reads"
        )
        with _push_errors(repo_id, again, whole):
            _set_tag(api, repo_id, kind, tag, commit.oid)
    return url.url


def _set_tag(api: HfApi, repo_id: str, kind: str, tag: str, commit: str) -> None:
    tagged = {ref.name: ref.target_commit for ref in api.list_repo_refs(repo_id, repo_type=kind).tags}
    if tagged.get(tag) == commit:
        return
    if tag in tagged:  # a tag cannot be moved
        api.delete_tag(repo_id, tag=tag, repo_type=kind)
    api.create_tag(repo_id, tag=tag, revision=commit, repo_type=kind)


@contextmanager
def _push_errors(repo_id: str, again: str, there: str) -> Iterator[None]:
    """
    Args:
        again: command that pushes it again.
        there: what the Hub holds of it if something goes wrong now.
    """
    try:
        yield
    except HFValidationError as error:
        raise HubError(f"{repo_id!r} is not a repository's name; names are ME/NAME.") from error
    except OfflineModeIsEnabled as error:
        raise HubError(f"HF_HUB_OFFLINE=1 forbids pushing {repo_id}; without it, push with:\n  {again}") from error
    except (HfHubHTTPError, httpx.HTTPError, json.JSONDecodeError, RuntimeError) as error:
        # The client's uploads report a RuntimeError, with what happened as its cause.
        cause = error.__cause__ if isinstance(error, RuntimeError) and error.__cause__ else error
        if _status(cause) == 403:
            reason = f"your token may not write there; {repo_id.split('/')[0]} is its owner's name."
        elif _status(cause) == 412:
            reason = "somebody else has pushed there in the meantime."
        else:
            reason = _refusal(cause)
        raise HubError(
            f"{repo_id} has not been pushed: {reason.rstrip('.')}; {there}. Push it again with:\n  {again}"
        ) from error


def _status(error: BaseException | None) -> int | None:
    return error.response.status_code if isinstance(error, HfHubHTTPError) else None


def _answer(error: BaseException) -> Any:
    """What the Hub answered, among the causes of an error; else the first cause."""
    while error.__cause__ is not None and _status(error) is None:
        error = error.__cause__
    return error


def _refusal(error: Any) -> str:
    """A sentence about what came back from the Hub, and what to do."""
    hub, status = f"the Hub at {constants.ENDPOINT}", _status(error)
    if status == 401:
        token = "refuses your token" if get_token() else "wants a token"
        return f"{hub} {token}: log in with `hf auth login` or set HF_TOKEN."
    if status == 403:
        return f"{hub} forbids it (status 403): your token does not have the right to."
    if status == 404:
        return f"{hub} has nothing at {error.response.url.path} (status 404): check the name, and HF_ENDPOINT."
    if status == 429:
        wait = error.response.headers.get("Retry-After", "")
        return f"{hub} has had too many requests (status 429): try again in {f'{wait} s' if wait else 'a while'}."
    if status is not None and status >= 500:
        return f"{hub} has a fault of its own (status {status}): try again later."
    if status is not None:
        return f"{hub} answers with status {status}: {_first_line(error)}."
    if isinstance(error, FileMetadataError | json.JSONDecodeError):
        return f"what answers at {constants.ENDPOINT} is not a Hub; it may be the login page of this network."
    if isinstance(error, LocalEntryNotFoundError):
        return f"{hub} was not asked for it: leave out local_files_only."
    return f"{hub} cannot be reached ({_first_line(error)}): try again once it can."


def _first_line(error: BaseException) -> str:
    return (str(error) or type(error).__name__).strip().splitlines()[0].rstrip(".")
