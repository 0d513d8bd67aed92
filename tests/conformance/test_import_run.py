"""Bags of three robots are imported: all numbers, ages and packets of the recordings equal those of the bag."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rosbags.rosbag2 import StoragePlugin
from support import bag_mappings, bags

from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.import_run import import_bags
from demorec.extensions.imports.mapping_file import read_mapping
from demorec.mcap import Recording

SECONDS = 1.5


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A robot's bag, its mapping, and the topic of each camera."""

    make: Callable[[float], bags.Notes]
    write: Callable[[bags.Notes, Path], Path]
    mapping: str
    cameras: dict[str, str]


LAYOUTS = {
    "franka": Layout(
        make=bags.franka,
        write=lambda notes, path: bags.write_rosbag2(notes, path / "bag"),
        mapping=bag_mappings.FRANKA,
        cameras={"wrist": "/camera/wrist_camera/color/image_raw", "scene": "/camera/scene_camera/color/image_raw"},
    ),
    "so101": Layout(
        make=bags.so101,
        write=lambda notes, path: bags.write_rosbag2(notes, path / "bag", storage=StoragePlugin.SQLITE3),
        mapping=bag_mappings.SO101,
        cameras={
            "front": "/follower/cam_front/image_raw/compressed",
            "side": "/static_camera/cam_side/image_raw/compressed",
        },
    ),
    "trossen": Layout(
        make=bags.trossen,
        write=lambda notes, path: bags.write_trossen(notes, path / "bag.mcap"),
        mapping=bag_mappings.TROSSEN,
        cameras={"high": "/cameras/cam_high/image", "wrist": "/cameras/cam_wrist/image"},
    ),
}


@pytest.fixture(scope="module", params=sorted(LAYOUTS))
def imported(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Layout, bags.Notes, Path]:
    """A layout, its messages and the run imported from them."""
    layout = LAYOUTS[request.param]
    folder = tmp_path_factory.mktemp(request.param)
    notes = layout.make(SECONDS)
    bag = layout.write(bags.in_order(notes), folder)
    mapping = bag_mappings.write_mapping(layout.mapping, folder / "robot.toml")
    (report,) = import_bags([bag], mapping, folder / "run").reports
    assert not report.findings
    return layout, notes, folder / "run"


def _open(run: Path) -> Recording:
    return Recording(run / "episodes" / "episode_000000.mcap")


def _vector(note: bags.Note, joints: tuple[str, ...], field: str) -> list[float]:
    """Return a source's part of a message, in the order of its joints."""
    values = note.body[field].tolist()
    return [values[note.body["name"].index(joint)] for joint in joints] if joints else list(values)


def test_numbers_and_ages(imported: tuple[Layout, bags.Notes, Path]) -> None:
    """Each row holds the messages that a brute-force search finds; its timestamp is that of the oldest."""
    _, notes, run = imported
    mapping = read_mapping(run.parent / "robot.toml")
    with _open(run) as recording:
        table = recording.table()
    assert len(table.time_ns) >= 40
    for feature, sources in mapping.features.items():
        values = table.features[feature]
        for row, time_ns in enumerate(table.time_ns.tolist()):
            taken = [
                max((n for n in bags.of_topic(notes, s.topic) if n.header_ns <= time_ns), key=lambda n: n.header_ns)
                for s in sources
            ]
            parts = [_vector(note, source.joints, source.field) for note, source in zip(taken, sources, strict=True)]
            assert values[row].tobytes() == np.array(list(chain(*parts)), dtype=values.dtype).tobytes()
            assert table.stamps[feature][row] == min(note.header_ns for note in taken)


def test_images(imported: tuple[Layout, bags.Notes, Path]) -> None:
    layout, notes, run = imported
    with _open(run) as recording:
        table = recording.table()
        for camera, topic in layout.cameras.items():
            of_topic = bags.of_topic(notes, topic)
            packets = list(recording.packets(camera))
            stamps = table.image_stamps[camera]
            by_stamp = {note.header_ns: note for note in of_topic}
            for row, time_ns in enumerate(table.time_ns.tolist()):
                expected = max(
                    (note for note in of_topic if note.header_ns <= time_ns), key=lambda note: note.header_ns
                )
                assert stamps[table.images[camera][row]] == expected.header_ns
            kept = next(row for row in recording.info.cameras if row.name == camera).kept
            for packet, stamp in zip(packets, stamps.tolist(), strict=True):
                if kept:
                    assert packet.data == bytes(by_stamp[stamp].body["data"])
            if not kept:
                images = list(recording.images(camera))
                assert len(images) == len(stamps)
                for shown, stamp in zip(images, stamps.tolist(), strict=True):
                    given = by_stamp[stamp].body["data"].astype(float)
                    assert np.abs(shown.astype(float) - given).mean() < 12


def _so101(tmp_path: Path, notes: bags.Notes) -> Path:
    return bags.write_mcap(bags.in_order(notes), tmp_path / "bag.mcap")


def _mapping(tmp_path: Path) -> Path:
    return bag_mappings.write_mapping(bag_mappings.SO101, tmp_path / "robot.toml")


def test_a_stream_that_ends_far_too_early(tmp_path: Path) -> None:
    notes = bags.changed(bags.so101(1.5), "/leader/joint_states", lambda k, note: note if k < 10 else None)
    with pytest.raises(BagError, match=r"ends 1\.2"):
        import_bags([_so101(tmp_path, notes)], _mapping(tmp_path), tmp_path / "run")


@pytest.mark.parametrize("encoding", ["bgr8", "mono8", "bayer_rggb8"])
def test_raw_images_of_other_encodings(encoding: str, tmp_path: Path) -> None:
    from demorec.extensions.imports.image_messages import raw_image

    image = bags.image(bags.EPOCH_NS, 1)
    smooth = np.broadcast_to(np.linspace(0, 255, bags.WIDTH).astype(np.uint8)[:, None], (bags.HEIGHT, bags.WIDTH, 3))
    given = {
        "bgr8": image[:, :, ::-1],
        "mono8": image[:, :, 0],
        "bayer_rggb8": smooth[:, :, 0],
    }[encoding]
    expected = {"mono8": np.repeat(image[:, :, :1], 3, axis=2), "bayer_rggb8": smooth}.get(encoding, image)
    padded = np.pad(np.ascontiguousarray(given).reshape(bags.HEIGHT, -1), ((0, 0), (0, 5)))
    values = {
        "encoding": encoding,
        "width": bags.WIDTH,
        "height": bags.HEIGHT,
        "step": padded.shape[1],
        "data": padded.reshape(-1),
    }
    assert np.abs(raw_image(values).astype(int) - expected).max() <= (5 if "bayer" in encoding else 0)


@pytest.mark.parametrize(("encoding", "size"), [("bayer_bggr8", (64, 47)), ("uyvy", (63, 48))])
def test_encodings_of_pixel_pairs_need_even_sides(encoding: str, size: tuple[int, int]) -> None:
    from demorec.extensions.imports.fields import FieldError
    from demorec.extensions.imports.image_messages import image_head

    width, height = size
    values = {"encoding": encoding, "width": width, "height": height, "data": bytes(2 * width * height)}
    with pytest.raises(FieldError, match=f"{encoding} image has {width}x{height} pixels, this encoding needs even"):
        image_head(values)


@pytest.mark.parametrize("encoding", ["uyvy", "yuyv"])
def test_luma_and_colour_of_pixel_pairs(encoding: str) -> None:
    """White, black and the primary colours of BT.601 by the formulas of ITU-R."""
    from demorec.extensions.imports.image_messages import raw_image

    colours = {(255, 255, 255): (235, 128, 128), (0, 0, 0): (16, 128, 128), (255, 0, 0): (81, 90, 240),
               (0, 255, 0): (145, 54, 34), (0, 0, 255): (41, 240, 110)}  # fmt: skip
    for rgb, (y, u, v) in colours.items():
        pair = (u, y, v, y) if encoding == "uyvy" else (y, u, y, v)
        values = {"encoding": encoding, "width": 16, "height": 8, "data": bytes(pair * 64)}
        assert np.abs(raw_image(values).astype(int) - rgb).max() <= 4


def test_an_undecodable_image_is_a_finding(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)).save(buffer, format="PNG")
    good, bad = bytearray(buffer.getvalue()), bytearray(buffer.getvalue())
    bad[200:220] = bytes(20)
    notes = bags.changed(
        bags.so101(1.0),
        "/follower/cam_front/image_raw/compressed",
        lambda k, note: bags.with_body(note, data=np.frombuffer(bad if k == 12 else good, np.uint8)),
    )
    (report,) = import_bags([_so101(tmp_path, notes)], _mapping(tmp_path), tmp_path / "run").reports
    (finding,) = [finding for finding in report.findings if finding.kind == "malformed"]
    assert finding.stream == "camera front"
    assert "1 message" in finding.text
    assert "damaged" in finding.text
    with _open(tmp_path / "run") as recording:
        assert (
            bags.of_topic(notes, "/follower/cam_front/image_raw/compressed")[12].header_ns
            not in recording.table().image_stamps["front"]
        )


def _video(tmp_path: Path, *, gop: int, first: int) -> tuple[Path, Path]:
    """A bag with a video whose first packets are missing, and its mapping."""
    notes = bags.trossen(1.5, gop=gop)
    notes = bags.changed(notes, "/cameras/cam_high/image", lambda k, note: note if k >= first else None)
    bag = bags.write_trossen(bags.in_order(notes), tmp_path / "bag.mcap")
    return bag, bag_mappings.write_mapping(bag_mappings.TROSSEN, tmp_path / "robot.toml")


def test_a_video_that_begins_between_keyframes(tmp_path: Path) -> None:
    bag, mapping = _video(tmp_path, gop=10, first=3)
    (report,) = import_bags([bag], mapping, tmp_path / "run").reports
    (finding,) = [finding for finding in report.findings if finding.kind == "keyframe"]
    assert "first 7 images" in finding.text
    with _open(tmp_path / "run") as recording:
        assert next(iter(recording.packets("high"))).is_keyframe
        assert len(list(recording.images("high"))) == len(recording.table().image_stamps["high"])


def test_a_video_without_keyframes_is_refused(tmp_path: Path) -> None:
    bag, mapping = _video(tmp_path, gop=1000, first=1)
    with pytest.raises(BagError, match="/cameras/cam_high/image cannot be decoded: it has no keyframe"):
        import_bags([bag], mapping, tmp_path / "run")
