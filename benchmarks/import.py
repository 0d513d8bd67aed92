"""The import of a bag compared with LeRobot's own writer on the same bag: CPU seconds a gigabyte, milliseconds a frame.

    python benchmarks/import.py                              a small sample
    python benchmarks/import.py --seconds 30 --rounds 5 --images h264 jpeg
    python benchmarks/import.py --images h264 --gop 30     video with a keyframe a second
    python benchmarks/import.py --growth 1 5 20              peak memory for this many gigabytes, as one bag and as many
    python benchmarks/import.py --forge /tmp/forge/bin/python    against forge-robotics, too

forge-robotics is not a dependency. It runs in a separate environment that has "forge-robotics[mcap,lerobot,video]",
Pillow and opencv-python-headless. Where it fails on a bag, its message takes the place of figures.

The bag is written by `mcap` and `rosbags`: two joint topics at 200 Hz and two 640x480 cameras. Each round runs the
candidates one after the other in separate processes; the time for loading libraries is excluded for all of them.
LeRobot's writer gets frames that demorec's reader decoded and aligned. "decoding and coding" is the minimum work of an
import of JPEG images into videos: Pillow decodes each image and libx264 encodes it, with the settings of demorec's
export.
"""

from __future__ import annotations

import argparse
import io
import json
import multiprocessing
import resource
import shutil
import statistics
import struct
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from support import bags

CAMERAS = ("/front/image", "/side/image")
WIDTH, HEIGHT, FPS = 640, 480, 30
AXES = ("height", "width", "channels")
MAPPING = """
[robot]
name = "benchmark"
[task]
text = "measure"
[clock]
fps = 30
[[features."observation.state"]]
topic = "/follower/joint_states"
field = "position"
[[features.action]]
topic = "/leader/joint_states"
field = "position"
[cameras.front]
topic = "/front/image"
[cameras.side]
topic = "/side/image"
"""


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Cost of one candidate in one round: CPU seconds of all threads and children, peak memory in bytes."""

    cpu: float
    peak: int


def scene(step: int, camera: int) -> NDArray[np.uint8]:
    """An image with texture and motion, as expensive to encode as a real one."""
    generator = np.random.default_rng(camera)
    coarse = generator.integers(0, 255, (HEIGHT // 16 + 4, WIDTH // 16 + 4, 3), np.uint8)
    large = coarse.repeat(16, axis=0).repeat(16, axis=1)
    shift = step % 48
    return np.ascontiguousarray(large[shift // 2 : shift // 2 + HEIGHT, shift : shift + WIDTH])


def make_bag(path: Path, seconds: float, images: str, gop: int) -> Path:
    """A bag with `images` (h264 with a keyframe before every `gop` images, or jpeg)."""
    bags.WIDTH, bags.HEIGHT = WIDTH, HEIGHT
    notes = bags.joints("/follower/joint_states", bags.SO101_JOINTS, bags.times(200, seconds, seed=1))
    notes += bags.joints("/leader/joint_states", bags.SO101_JOINTS, bags.times(200, seconds, seed=2), shift=0.1)
    for camera, topic in enumerate(CAMERAS):
        moments = bags.times(FPS, seconds, seed=3, jitter=0.01)
        loop = [scene(step, camera) for step in range(48)]
        if images == "h264":
            packets = bags.video([loop[step % 48] for step in range(len(moments))], gop=gop)
        else:
            coded = [bags.jpeg(image) for image in loop]
            packets = [coded[step % 48] for step in range(len(moments))]
        notes += [
            bags.Note(
                topic=topic,
                type="sensor_msgs/msg/CompressedImage",
                log_ns=moment + 1_000_000,
                header_ns=moment,
                body={"format": images, "data": np.frombuffer(packet, np.uint8)},
            )
            for moment, packet in zip(moments, packets, strict=True)
        ]
    return bags.write_mcap(bags.in_order(notes), path)


def ours(bags_: list[Path], out: Path, mapping: Path, *, exports: bool) -> None:
    """Import the bags into a run, and with `exports` export a LeRobot dataset."""
    from demorec.extensions.imports.import_run import import_bags

    import_bags(bags_, mapping, out / "run")
    if exports:
        from demorec.datasets.lerobot.export import export_lerobot
        from demorec.datasets.lerobot.options import ExportOptions

        export_lerobot([out / "run"], out / "dataset", ExportOptions(verify=False))


def lerobots(bag: Path, out: Path, mapping: Path) -> None:
    """Write the same rows with LeRobotDataset.add_frame and save_episode, with its defaults."""
    import av
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from demorec.extensions.imports.bag import open_bag
    from demorec.extensions.imports.decoding import decode_message
    from demorec.extensions.imports.fields import image_bytes
    from demorec.extensions.imports.image_messages import decode_image
    from demorec.extensions.imports.mapping_file import read_mapping
    from demorec.extensions.imports.rows import Timelines
    from demorec.extensions.imports.streams import read_streams

    known = read_mapping(mapping)
    opened = open_bag(bag)
    streams = read_streams(opened, known)
    lines = Timelines(streams, known)
    rows = lines.rows()
    features: dict[str, object] = {
        f"observation.images.{name}": {"dtype": "video", "shape": (HEIGHT, WIDTH, 3), "names": list(AXES)}
        for name in rows.cameras
    }
    for name in rows.table.features:
        names = [element for key, _ in lines.sources(name) for element in lines.lines[key].stream.names]
        features[name] = {"dtype": "float32", "shape": (len(names),), "names": names}
    dataset = LeRobotDataset.create("local/x", fps=FPS, features=features, root=out / "dataset", use_videos=True)
    kept = {name: list[NDArray[np.uint8]]() for name in rows.cameras}
    packets: dict[str, list[bytes]] = {name: [] for name in rows.cameras}
    topics = {camera.topic: name for name, camera in known.cameras.items()}
    for message in opened.messages([], topics.keys()):
        values, name = decode_message(message), topics[message.channel.topic]
        if values["format"] == "jpeg":
            kept[name].append(decode_image(values))
        else:
            packets[name].append(image_bytes(values))
    for name, coded in packets.items():
        if coded:
            with av.open(io.BytesIO(b"".join(coded)), mode="r", format="h264") as file:
                kept[name] += [frame.to_ndarray(format="rgb24").astype(np.uint8) for frame in file.decode(video=0)]
    for row in range(rows.table.num_frames):
        frame: dict[str, object] = {
            f"observation.images.{name}": kept[name][int(camera.taken[rows.table.images[name][row]])]
            for name, camera in rows.cameras.items()
        }
        frame |= {name: vectors[row].astype(np.float32) for name, vectors in rows.table.features.items()}
        dataset.add_frame({**frame, "task": "measure"})
    dataset.save_episode()
    dataset.finalize()


def decoding_and_coding(bag: Path) -> None:
    """Only decode every image of the bag and encode it once, as the export does."""
    from demorec.core.config import VideoConfig
    from demorec.extensions.imports.bag import open_bag
    from demorec.extensions.imports.decoding import decode_message
    from demorec.extensions.imports.image_messages import decode_image
    from demorec.mcap.video import make_encoder

    encoders = {topic: make_encoder(video=VideoConfig(), width=WIDTH, height=HEIGHT, fps=FPS) for topic in CAMERAS}
    for message in open_bag(bag).messages([], CAMERAS):
        encoders[message.channel.topic].encode(decode_image(decode_message(message)))
    for encoder in encoders.values():
        encoder.finish()


FORGE = """
import json, resource, sys
import av, cv2, datasets, pyarrow.parquet
import forge.formats.lerobot_v3, forge.formats.mcap, mcap_ros2.decoder
from forge.convert.converter import convert
def used():
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)
begin = used()
result = convert(sys.argv[1], sys.argv[2], target_format="lerobot-v3", fps=30.0)
(line,) = [line for line in open("/proc/self/status") if line.startswith("VmHWM")]
peak = int(line.split()[1]) << 10
errors = [str(error) for error in result.errors]
print(json.dumps({"cpu": used() - begin, "peak": peak, "frames": result.total_frames, "errors": errors}))
"""


def forges(python: Path, bag: Path, out: Path) -> Cost | str:
    """Import the bag into a LeRobot dataset with forge-robotics; returns its message if it fails."""
    shutil.rmtree(out, ignore_errors=True)
    command = [str(python), "-c", FORGE, str(bag), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    shutil.rmtree(out, ignore_errors=True)
    if done.returncode:
        return done.stderr.strip().splitlines()[-1]
    told = json.loads(done.stdout.splitlines()[-1])
    if told["errors"] or not told["frames"]:
        return "; ".join(told["errors"]) or "no frames"
    return Cost(cpu=told["cpu"], peak=told["peak"])


def _child(
    candidate: str, bags_: list[Path], out: Path, mapping: Path, answer: multiprocessing.queues.Queue[Cost]
) -> None:
    import pandas as pd  # noqa: F401, the export loads it when it first needs it

    if candidate == "lerobot":
        import lerobot.datasets.lerobot_dataset  # noqa: F401

    begin = _used()
    if candidate == "lerobot":
        lerobots(bags_[0], out, mapping)
    elif candidate == "decoding and coding":
        decoding_and_coding(bags_[0])
    else:
        ours(bags_, out, mapping, exports=candidate == "import and export")
    answer.put(Cost(cpu=_used() - begin, peak=_peak()))


def _used() -> float:
    return sum(
        usage.ru_utime + usage.ru_stime
        for usage in (resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN))
    )


def _peak() -> int:
    """Peak memory of this process, bytes; getrusage would include the parent's."""
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")]
    return int(line.split()[1]) << 10


def measure(candidate: str, bags_: list[Path], folder: Path) -> Cost:
    """One run of a candidate in a fresh process."""
    out = folder / candidate.replace(" ", "_")
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    mapping = folder / "robot.toml"
    mapping.write_text(MAPPING)
    context = multiprocessing.get_context("spawn")
    answer: multiprocessing.queues.Queue[Cost] = context.Queue()
    process = context.Process(target=_child, args=(candidate, bags_, out, mapping, answer))
    process.start()
    cost = answer.get()
    process.join()
    shutil.rmtree(out, ignore_errors=True)
    return cost


def grow(path: Path, images: str, gop: int, gigabytes: float) -> Path:
    """A bag of that size: repetitions of a ten-second piece, each shifted by another ten seconds."""
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    piece = make_bag(path.with_suffix(".piece"), 10.0, images, gop)
    with piece.open("rb") as source, path.open("wb") as target:
        writer = Writer(target, compression=CompressionType.NONE)
        writer.start()
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        messages = list(make_reader(source).iter_messages())
        shift = 0
        while target.tell() < gigabytes * 1e9:
            for schema, channel, message in messages:
                assert schema is not None
                if channel.id not in channels:
                    schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channels[channel.id] = writer.register_channel(
                        channel.topic, channel.message_encoding, schemas[schema.id]
                    )
                seconds, nanoseconds = struct.unpack_from("<iI", message.data, 4)  # of the header, after CDR's own
                data = bytearray(message.data)
                struct.pack_into("<iI", data, 4, seconds + shift, nanoseconds)
                log_ns = message.log_time + shift * bags.NS
                writer.add_message(channels[channel.id], log_ns, bytes(data), log_ns)
            shift += 10
        writer.finish()
    piece.unlink()
    return path


def table(images: str, bag: Path, options: argparse.Namespace, folder: Path) -> None:
    """Measure all candidates on a bag in turn and print the medians."""
    candidates = ["import", "import and export", *(["decoding and coding"] if images == "jpeg" else [])]
    candidates += [] if options.ours else ["lerobot"]
    costs: dict[str, list[Cost]] = {candidate: [] for candidate in candidates}
    told = ""
    for _ in range(options.rounds):
        for candidate in candidates:
            costs[candidate].append(measure(candidate, [bag], folder))
        if options.forge is not None:
            cost = forges(options.forge, bag, folder / "forge")
            if isinstance(cost, str):
                told = cost
            else:
                costs.setdefault("forge", []).append(cost)
    frames, size = int(options.seconds * FPS), bag.stat().st_size
    print(f"{images}, {size / 1e6:.1f} MB, {frames} frames, two cameras 640x480")
    print(f"  {'':19} {'CPU ms/frame':>13} {'CPU s/GB':>9} {'x import':>9}")
    medians = {candidate: statistics.median(cost.cpu for cost in found) for candidate, found in costs.items()}
    for candidate, cpu in medians.items():
        ratio = cpu / medians["import"]
        print(f"  {candidate:19} {1e3 * cpu / frames:13.3f} {cpu / size * 1e9:9.1f} {ratio:9.1f}")
    if images == "jpeg":
        share = medians["decoding and coding"] / medians["import and export"]
        print(f"  decoding and coding take {share:.0%} of import and export")
    if told:
        print(f"  forge fails: {told}")


def tell(bags_: list[Path], folder: Path) -> None:
    """Print the cost of an import by forge-robotics."""
    gigabytes, cost = sum(bag.stat().st_size for bag in bags_) / 1e9, measure("import", bags_, folder)
    peak, cpu = cost.peak / 1e6, cost.cpu / gigabytes
    print(f"{gigabytes:.1f} GB in {len(bags_)} bags: peak {peak:.0f} MB, {cpu:.1f} CPU s/GB", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=4.0, help="length of the bag")
    parser.add_argument("--gop", type=int, default=2, help="images from one keyframe of H.264 video to the next")
    parser.add_argument("--rounds", type=int, default=2, help="0 for --growth alone")
    parser.add_argument("--images", nargs="+", choices=("h264", "jpeg"), default=["h264", "jpeg"])
    parser.add_argument(
        "--growth", type=float, nargs="*", default=[], help="gigabytes of bags whose peak memory is measured"
    )
    parser.add_argument("--ours", action="store_true", help="leave LeRobot's writer out, which is slow")
    parser.add_argument("--forge", type=Path, help="Python of an environment with forge-robotics, to compare with it")
    parser.add_argument("--folder", type=Path, help="folder for the bags (default: the system's folder)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="demorec-import-", dir=options.folder) as name:
        folder = Path(name)
        for images in options.images if options.rounds else ():
            bag = make_bag(folder / f"{images}.mcap", options.seconds, images, options.gop)
            table(images, bag, options, folder)
        for gigabytes in options.growth:
            one = grow(folder / "one.mcap", options.images[0], options.gop, 1)
            many = [folder / f"part_{number:04d}.mcap" for number in range(round(gigabytes))]
            for path in many:
                path.hardlink_to(one)
            tell(many, folder)
            for path in many:
                path.unlink()
            tell([grow(one, options.images[0], options.gop, gigabytes)], folder)


if __name__ == "__main__":
    main()
