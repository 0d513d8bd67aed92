"""The HDF5 export: h5py reads the same values as in the recordings."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.export import export, make_run

from demorec.core.errors import ConfigError
from demorec.mcap import Recording


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("run") / "run", (8, 7, 5), failures=(1,), depth=True)


def recording(run: Path, index: int) -> Recording:
    return Recording(run / "episodes" / f"episode_{index:06d}.mcap")


def test_numbers_are_those_of_the_recording(run: Path, tmp_path: Path) -> None:
    export(run, tmp_path / "d.hdf5", "hdf5", privileged=True)
    with h5py.File(tmp_path / "d.hdf5") as file:
        assert set(file["data"]) == {"demo_0", "demo_1", "demo_2"}
        assert file["data"].attrs["total"] == 20
        for index in range(3):
            demo = file[f"data/demo_{index}"]
            with recording(run, index) as source:
                trajectory = source.trajectory()
                assert demo.attrs["model_file"] == source.description()
                assert demo.attrs["instruction"] == source.info.instruction
            assert demo.attrs["num_samples"] == trajectory.num_frames
            assert demo.attrs["success"]
            observed = {name: data[()] for name, data in demo["obs"].items()}
            recorded = {
                "robot0_joint_pos": trajectory.joint_position[:, :7],
                "robot0_gripper_qpos": trajectory.gripper_width[:, np.newaxis],
                "robot0_joint_vel": trajectory.joint_velocity[:, :7],
                "robot0_gripper_qvel": trajectory.joint_velocity[:, 7:].sum(axis=1, keepdims=True),
                "robot0_eef_pos": trajectory.base_from_tcp[:, :3],
            }
            for name, expected in recorded.items():
                assert observed[name].dtype == np.float64
                np.testing.assert_array_equal(observed[name], expected, err_msg=name)
            same = (observed["robot0_eef_quat"] * trajectory.base_from_tcp[:, 3:]).sum(axis=1)
            np.testing.assert_allclose(np.abs(same), 1, atol=1e-12)  # either sign is the same rotation
            target = np.column_stack([trajectory.action_joint_target, trajectory.action_gripper])
            np.testing.assert_array_equal(demo["actions"][()], target)
            state = [trajectory.joint_position, trajectory.joint_velocity, *trajectory.object_poses.values()]
            np.testing.assert_array_equal(demo["states"][()], np.concatenate(state, axis=1))
            last = [0] * (trajectory.num_frames - 1) + [1]
            assert demo["rewards"][()].tolist() == demo["dones"][()].tolist() == last
            assert observed["object"].shape[1] == len(json.loads(demo["obs/object"].attrs["names"]))


def test_images_are_the_decoded_ones(run: Path, tmp_path: Path) -> None:
    export(run, tmp_path / "d.hdf5", "hdf5", depth=True)
    with h5py.File(tmp_path / "d.hdf5") as file:
        for index in range(3):
            demo = file[f"data/demo_{index}/obs"]
            with recording(run, index) as source:
                for camera in ("front", "wrist"):
                    images, distances = demo[f"{camera}_image"], demo[f"{camera}_depth"]
                    np.testing.assert_array_equal(images[()], np.stack(list(source.images(camera))))
                    np.testing.assert_array_equal(distances[..., 0], np.stack(list(source.depth(camera))))
                    assert (images.chunks, images.compression) == ((1, 48, 64, 3), "gzip")
                    assert (distances.chunks, distances.dtype) == ((1, 48, 64, 1), np.float32)


@pytest.mark.parametrize(("share", "valid"), [(0.0, []), (0.1, []), (0.5, ["demo_1"]), (0.7, ["demo_1", "demo_2"])])
def test_masks_divide_the_episodes(run: Path, tmp_path: Path, share: float, valid: list[str]) -> None:
    export(run, tmp_path / "d.hdf5", "hdf5", valid_share=share)
    with h5py.File(tmp_path / "d.hdf5") as file:
        found = [[name.decode() for name in file[f"mask/{mask}"]] for mask in ("train", "valid")]
    assert found[1] == valid
    assert sorted(found[0] + found[1]) == ["demo_0", "demo_1", "demo_2"]


def test_env_args_name_an_environment(run: Path, tmp_path: Path) -> None:
    import gymnasium

    import demorec.extensions.policies.gym_env  # noqa: F401  (registers the environments)

    # An environment has images of one size, the recordings of this run have two.
    features = ("observation.velocity", "observation.images.wrist")
    export(run, tmp_path / "d.hdf5", "hdf5", features=features, action="ee")
    with h5py.File(tmp_path / "d.hdf5") as file:
        described = json.loads(file["data"].attrs["env_args"])
        images = [name for name in file["data/demo_0/obs"] if name.endswith("_image")]
        shapes = {name.removesuffix("_image"): file[f"data/demo_0/obs/{name}"].shape[1:] for name in images}
    assert described["type"] == 2  # robomimic's EnvType.GYM_TYPE
    env = gymnasium.make(described["env_name"], **described["env_kwargs"])
    assert env.action_space.shape == (8,)
    observation, _ = env.reset(seed=0)
    assert {name: pixels.shape for name, pixels in observation["pixels"].items()} == shapes
    env.close()


def test_a_third_party_file_is_not_replaced(run: Path, tmp_path: Path) -> None:
    """A file of another layout, and a robomimic file that demorec did not write."""
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["thesis"] = np.arange(5)
    with h5py.File(tmp_path / "b.hdf5", "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"], data.attrs["total"] = json.dumps({"env_name": "Lift", "type": 1, "env_kwargs": {}}), 5
        data.create_group("demo_0")["actions"] = np.zeros((5, 7))
    for path in sorted(tmp_path.iterdir()):
        before = path.read_bytes()
        with pytest.raises(ConfigError, match="it is not a robomimic dataset"):
            export(run, path, "hdf5", overwrite=True)
        assert path.read_bytes() == before


@pytest.mark.parametrize(
    "addition", ["mine", "mask/10_percent", "data/demo_0/obs/language", "data/demo_0/notes", "data/mine"]
)
def test_a_file_with_additions_is_not_replaced(run: Path, tmp_path: Path, addition: str) -> None:
    target = tmp_path / "d.hdf5"
    options = {"privileged": True, "depth": True, "valid_share": 0.5, "overwrite": True}
    for _ in range(2):  # a demorec file with everything that an export can write is replaced
        export(run, target, "hdf5", **options)
    with h5py.File(target, "a") as file:
        file[addition] = np.arange(5)
    before = target.read_bytes()
    with pytest.raises(ConfigError, match=f"files that are not part of .*{addition}"):
        export(run, target, "hdf5", **options)
    assert target.read_bytes() == before


@pytest.mark.parametrize("place", ["/", "data", "data/demo_0"])
def test_a_file_with_foreign_notes_or_links_is_not_replaced(run: Path, tmp_path: Path, place: str) -> None:
    for number, word in enumerate(("note", "link")):
        target = tmp_path / f"{number}.hdf5"
        export(run, target, "hdf5", episodes="0")
        with h5py.File(target, "a") as file:
            if word == "note":
                file[place].attrs[word] = "years of work"
            else:
                file[place][word] = h5py.SoftLink("/data/demo_0/actions")
        before = target.read_bytes()
        with pytest.raises(ConfigError, match=f"files that are not part of .*{word}"):
            export(run, target, "hdf5", overwrite=True)
        assert target.read_bytes() == before


def test_robomimic_reads_it(run: Path, tmp_path: Path) -> None:
    """robomimic's own reader, where installed; it is not a dependency, since its own dependencies need a compiler."""
    dataset = pytest.importorskip("robomimic.utils.dataset", reason="robomimic is not installed")
    from robomimic.utils import file_utils, obs_utils

    export(run, tmp_path / "d.hdf5", "hdf5", valid_share=0.5)
    low = ["robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"]
    obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": low, "rgb": ["front_image"]}})
    assert file_utils.get_env_metadata_from_dataset(tmp_path / "d.hdf5")["env_name"] == "demorec/PickPlace-v0"
    shapes = file_utils.get_shape_metadata_from_dataset(tmp_path / "d.hdf5", [*low, "front_image"])
    assert (shapes["ac_dim"], shapes["all_shapes"]["front_image"]) == (8, [3, 48, 64])
    for mask, index in (("train", 0), ("valid", 1)):
        read = dataset.SequenceDataset(
            hdf5_path=str(tmp_path / "d.hdf5"),
            obs_keys=[*low, "front_image"],
            dataset_keys=["actions", "rewards", "dones"],
            seq_length=3,
            filter_by_attribute=mask,
            load_next_obs=False,
        )
        with recording(run, index) as source:
            item, trajectory = read[1], source.trajectory()
            np.testing.assert_array_equal(item["obs"]["front_image"][0], source.image("front", 1))
        np.testing.assert_array_equal(item["obs"]["robot0_eef_pos"], trajectory.base_from_tcp[1:4, :3])
        np.testing.assert_array_equal(item["actions"][:, :7], trajectory.action_joint_target[1:4].astype(np.float32))
