"""Uploads a finished dataset to the Hugging Face Hub."""

from __future__ import annotations

from pathlib import Path

from demorec.errors import ExportError, MissingDependencyError, in_words
from demorec.lerobot.layout import CODEBASE_VERSION


def push_to_hub(folder: Path, repo_id: str, *, private: bool) -> str:
    """Upload the folder as a dataset repository, tagged with the format's version as LeRobot expects it.

    Returns:
        Its address.

    Raises:
        ExportError: No token, no network, no right to write there; the folder stays as it is.
        MissingDependencyError: The Hub's client, which comes with LeRobot, is not installed.
    """
    try:
        from huggingface_hub import HfApi, get_token
    except ImportError as error:
        raise MissingDependencyError(
            f"Uploading the dataset, which is kept ({folder}),", "huggingface_hub", "pip install huggingface_hub"
        ) from error
    if get_token() is None:
        raise ExportError(
            "The dataset was not uploaded, there is no Hugging Face token: type hf auth login, or set HF_TOKEN, and "
            f"then: hf upload {repo_id} {folder} --repo-type dataset"
        )
    hub = HfApi()
    try:
        url = hub.create_repo(repo_id, repo_type="dataset", private=private, exist_ok=True)
        hub.upload_folder(
            repo_id=repo_id,
            folder_path=folder,
            repo_type="dataset",
            commit_message="Upload dataset",
        )
        hub.create_tag(repo_id, tag=CODEBASE_VERSION, repo_type="dataset", exist_ok=True)
    except Exception as error:  # the hub's client raises errors of several HTTP libraries
        raise ExportError(
            f"The dataset was not uploaded to {repo_id} ({in_words(error)}); it is kept: {folder}"
        ) from error
    return str(url)
