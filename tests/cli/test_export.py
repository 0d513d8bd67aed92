"""`demorec export` from the command line: exit codes, one-sentence errors, output."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from support.commands import exit_code
from support.export import episode_rows, files_of, make_run

from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import ExportOptions
from demorec.extensions.datasets.inspect import dataset_digest


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("run") / "run", (8, 7), failures=(1,))


def test_an_export(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "d"
    assert exit_code("export", "lerobot", run, "--out", out, "--repo-id", "me/cubes", "--no-verify") == 0
    printed = capsys.readouterr()
    assert "2 episodes, 15 frames" in printed.out
    assert "1 failed or unfinished attempt left out" in printed.out
    assert dataset_digest(out) in printed.out
    assert printed.err == ""  # quiet without a terminal
    assert "# me/cubes" in (out / "README.md").read_text()


def test_recordings_moved_into_failed_stay_out(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sorted_run = tmp_path / "run"
    shutil.copytree(run, sorted_run)
    good = min((sorted_run / "episodes").glob("*.mcap"))
    good.rename(sorted_run / "failed" / good.name)
    assert exit_code("export", "lerobot", sorted_run, "--out", tmp_path / "d", "--no-verify") == 0
    printed = capsys.readouterr().out
    assert "1 episode, 7 frames" in printed
    assert "2 failed or unfinished attempts left out" in printed


def test_recordings_left_out_by_flags_are_counted(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("export", "lerobot", run, "--out", tmp_path / "d", "--no-verify", "--corrected-only", "--episodes", "0")
    assert exit_code(*words) == 0
    printed = capsys.readouterr()
    assert "1 episode, 8 frames" in printed.out  # no takeover happens in a demonstration, so it is exported
    assert "2 recordings left out by --episodes or --corrected-only." in printed.out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--features", "observation.effor"), "Did you mean 'observation.effort'?"),
        (("--episodes", "5:2"), "5:2 ends before it begins"),
        (("--repo-id", "cubes"), "must be OWNER/NAME"),
        (("--append", "--overwrite"), "exclude each other"),
        (("--action", "velocity"), "joint_increment"),
    ],
)
def test_mistakes_are_one_sentence(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], message: str
) -> None:
    assert exit_code("export", "lerobot", run, "--out", tmp_path / "d", "--no-verify", *arguments) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert "Traceback" not in printed.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("token", [None, "hf_made_up"])
def test_a_failed_upload_keeps_the_dataset(
    run: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    token: str | None,
) -> None:
    """The upload fails without a token, and without a network."""
    monkeypatch.setattr("huggingface_hub.get_token", lambda: token)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    out = tmp_path / "d"
    arguments = ("--no-verify", "--push-to-hub", "--repo-id", "me/cubes")
    assert exit_code("export", "lerobot", run, "--out", out, *arguments) == 1
    printed = capsys.readouterr().err
    assert "was not uploaded to me/cubes" in printed
    assert "Type hf auth login" in " ".join(printed.split())
    assert "Traceback" not in printed
    assert len(episode_rows(out)) == 2


def test_an_upload_is_private_and_tagged(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls: list[tuple[object, ...]] = []

    class Hub:
        def create_repo(self, repo_id: str, **arguments: object) -> str:
            calls.append(("create", repo_id, arguments))
            return f"https://hub/{repo_id}"

        def upload_folder(self, **arguments: object) -> None:
            calls.append(("upload", arguments["folder_path"], len(files_of(arguments["folder_path"]))))  # type: ignore[arg-type]

        def create_tag(self, repo_id: str, **arguments: object) -> None:
            calls.append(("tag", repo_id, arguments["tag"]))

    monkeypatch.setattr("huggingface_hub.HfApi", Hub)
    out = tmp_path / "d"
    arguments = ("--no-verify", "--push-to-hub", "--repo-id", "me/cubes")
    assert exit_code("export", "lerobot", run, "--out", out, *arguments) == 0
    assert calls[0] == ("create", "me/cubes", {"repo_type": "dataset", "private": True, "exist_ok": True})
    assert calls[1] == ("upload", out, len(files_of(out)))
    assert calls[2] == ("tag", "me/cubes", "v3.0")
    assert "https://hub/me/cubes" in capsys.readouterr().out


@pytest.mark.slow
def test_verification_passes_a_good_dataset_and_drops_a_bad_one(run: Path, tmp_path: Path) -> None:
    report = export_lerobot([run], tmp_path / "good", ExportOptions(privileged=True))
    assert report.verified_frames == 4
    # The recordings change after they were read, so the dataset no longer matches them.
    changing = tmp_path / "run"
    shutil.copytree(run, changing)

    def swap(done: int, total: int) -> None:
        if done == total:
            episodes = changing / "episodes"
            (episodes / "episode_000000.mcap").rename(episodes / "x")
            (episodes / "episode_000001.mcap").rename(episodes / "episode_000000.mcap")
            (episodes / "x").rename(episodes / "episode_000001.mcap")

    with pytest.raises(Exception, match="dropped") as error:
        export_lerobot([changing], tmp_path / "bad", ExportOptions(), swap)
    assert "observation.state" in str(error.value)
    assert not (tmp_path / "bad").exists()
