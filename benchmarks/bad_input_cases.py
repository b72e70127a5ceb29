"""The cases of ``bad_inputs.py``: what is broken, and the command that meets it."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bad_input_changes import (
    BOMB,
    CUBE,
    DIGITS,
    NO_Z,
    ROWS,
    SPEC,
    arrays,
    c3d,
    clouds,
    cut,
    digits_in_pose,
    document,
    every,
    flip,
    huge_pictures,
    interrupted,
    intrinsic,
    listing,
    looks_away,
    masks,
    millimetres,
    moved_truth,
    nerfstudio,
    of_view,
    pipe,
    png_header,
    put,
    rate,
    same_cameras,
    scene_yaml,
    spec,
    table,
    time_stamps,
    truth,
    write,
)

SYNTH = "synth {dir}/spec.yaml --out {out}"
INSPECT = "inspect {scene} --out {dir}/sheet.png"
NEW = "reconstruct {scene} --out {out} --config {dir}/tiny.yaml"
AGAIN = "identify {scene} --out {run} --config {dir}/tiny.yaml"
EVALUATE = "evaluate {run} --truth {scene}/gt"
SIMULATE = "simulate {run} --frames 3 --out {out}"
TRACKS = "inspect {tracks} --out {dir}/sheet.png"


@dataclass(frozen=True)
class Case:
    """``command``: words with {scene}, {run}, {tracks}, {out} and {dir} filled in. ``change`` breaks something in the
    case's folder. goes_on: the command says what it dropped, and ends with exit code 0. code: that is expected."""

    group: str
    name: str
    command: str
    change: Callable[[Path], Any] = lambda folder: None
    goes_on: bool = False
    code: int = 2
    disk: str = ""


def files_of_a_run() -> Iterator[Case]:
    group = "files of a run"
    for name, command in (
        ("trajectory.npz", EVALUATE),
        ("gaussians.ply", EVALUATE),
        ("deformation.safetensors", EVALUATE),
        ("calibration.json", EVALUATE),
        ("law.safetensors", SIMULATE),
        ("particles.safetensors", SIMULATE),
        ("twin.yaml", SIMULATE),
        ("run.yaml", SIMULATE),
    ):
        yield Case(group, f"{name} cut in half", command, cut(f"run/{name}"))
        yield Case(group, f"{name} with other bytes", command, flip(f"run/{name}"))
        yield Case(group, f"{name} empty", command, write(f"run/{name}", b""))
        yield Case(group, f"{name} is a FIFO", command, pipe(f"run/{name}"))
    for name, change in (
        ("cut in half", cut("run/rollout.npz")),
        ("with other bytes", flip("run/rollout.npz")),
        ("with NaN", arrays("run/rollout.npz", lambda a: a.update(positions=a["positions"] * np.nan))),
        ("with another shape", arrays("run/rollout.npz", lambda a: a.update(positions=a["positions"][0]))),
    ):
        yield Case(group, f"rollout.npz {name}", EVALUATE, change, goes_on=True)
    for name, change in (
        ("with NaN", lambda a: a.update(positions=a["positions"] * np.nan)),
        ("with another shape", lambda a: a.update(positions=a["positions"][:, 0])),
        ("with a volume of −1", lambda a: a.update(volume=-1.0)),
        ("of objects", lambda a: a.update(positions=np.array([{}], object))),
        ("with network settings that are no JSON", lambda a: a.update(network_settings="{")),
    ):
        yield Case(group, f"trajectory.npz {name}", EVALUATE, arrays("run/trajectory.npz", change))
    yield Case(group, "material.json cut in half", AGAIN, cut("run/material.json"), goes_on=True)
    for name, data in (
        ("of random bytes", bytes(range(256)) * 20),
        ("empty", b""),
        ("of another stage", {"iteration": 3}),
    ):
        yield Case(group, f"checkpoint {name}", AGAIN, interrupted(data), goes_on=True)


def edited_by_hand() -> Iterator[Case]:
    group = "run.yaml, twin.yaml by hand"
    run = "run/run.yaml"
    for name, change in (
        ("config: unknown key", put("config", "reconstruct", "iteratoins", value=3)),
        ("config: NaN", put("config", "simulator", "courant_number", value=float("nan"))),
        ("config: a text", put("config", value="standard")),
        ("split: fit_frames 'all'", put("split", "fit_frames", value="all")),
        ("split: fit_frames −1", put("split", "fit_frames", value=-1)),
        ("split: holdout_cameras 3", put("split", "holdout_cameras", value=3)),
        ("split: unknown camera", put("split", "holdout_cameras", value=[99])),
        ("stages: a list", put("stages", value=[])),
        ("stages: without identify", lambda d: d["stages"].pop("identify") and None),
        ("stages: state 'finished'", put("stages", "identify", "state", value="finished")),
        ("stages: seconds NaN", put("stages", "identify", "seconds", value=float("nan"))),
        ("scene: a number", put("scene", value=3)),
        ("scene: no path", lambda d: d["scene"].pop("path") and None),
        ("schema 99", put("schema", value=99)),
        ("a list", lambda d: [1, 2]),
    ):
        yield Case(group, f"run.yaml: {name}", SIMULATE, document(run, change))
    twin = "run/twin.yaml"
    for name, change in (
        ("volume −1", put("bodies", 0, "volume", "value", value=-1.0)),
        ("volume NaN", put("bodies", 0, "volume", "value", value=float("nan"))),
        ("volume 1e300", put("bodies", 0, "volume", "value", value=1e300)),
        ("volume not that of the particles", put("bodies", 0, "volume", "value", value=40.0)),
        ("density 1e300", put("bodies", 0, "density", "value", value=1e300)),
        ("density as text", put("bodies", 0, "density", "value", value="1000")),
        ("contact 'glue'", put("boundary", "contact", value="glue")),
        ("friction 1e300", put("boundary", "friction", value=1e300)),
        ("up of length 0", put("up", value=[0.0, 0.0, 0.0])),
        ("up of length 2", put("up", value=[0.0, 2.0, 0.0])),
        ("ground normal 0", put("boundary", "ground", "normal", value=[0.0, 0.0, 0.0])),
        ("ground far above", put("boundary", "ground", "height", "value", value=50.0)),
        ("gravity 1e300", put("gravity", "value", value=[0.0, -1e300, 0.0])),
        ("velocity 1e30", put("initial_conditions", 0, "velocity", "value", value=[1e30, 0.0, 0.0])),
        ("fps 1e300", put("initial_conditions", 0, "fps", value=1e300)),
        ("fps true", put("initial_conditions", 0, "fps", value=True)),
        ("no bodies", put("bodies", value=[])),
        ("unknown body", put("initial_conditions", 0, "body", value="nobody")),
        ("unknown key", put("colour", value="red")),
        ("unknown effect", put("effects", value=[{"effect": "magic", "parameters": {}}])),
        ("law in another folder", put("bodies", 0, "law", "file", value="../../../etc/passwd")),
        ("another law's parameter", put("bodies", 0, "law", "parameters", "youngs_modulus", "value", value=1.0)),
        ("simulator.subparticles 3", put("simulator", "subparticles", value=3)),
        ("fit is a list", put("fit", value=[])),
    ):
        yield Case(group, f"twin.yaml: {name}", SIMULATE, document(twin, change))


def texts() -> Iterator[Case]:
    group = "YAML and JSON"
    config = "inspect {scene} --out {dir}/sheet.png --config {dir}/c.yaml"
    for name, text in (
        ("a key twice", "seed: 1\nseed: 2\n"),
        ("400 digits", f"seed: {DIGITS}\n"),
        ("5000 digits", f"seed: {DIGITS * 13}\n"),
        ("a date that does not exist", "seed: 2024-99-99\n"),
        ("nested 5000 deep", f"seed: {'[' * 5000}{']' * 5000}\n"),
        ("aliases of aliases", BOMB),
        ("an alias of itself", "seed: &a [*a]\n"),
        ("a Python object", "seed: !!python/object/apply:os.system [ls]\n"),
        ("bytes", b"\xff\xfe\x00"),
        ("NaN", "simulator: {courant_number: .nan}\n"),
        ("a list", "- 1\n"),
        ("a directory", None),
    ):
        change = (lambda f: (f / "c.yaml").mkdir()) if text is None else write("c.yaml", text)
        yield Case(group, f"--config: {name}", config, change)
    yield Case(group, "--config is a FIFO", config, pipe("c.yaml"))
    yield Case(group, "scene.yaml is a FIFO", INSPECT, pipe("scene/scene.yaml"))
    yield Case(group, "scene.yaml: fps twice", INSPECT, scene_yaml("fps: 24\nfps: 30\n"))
    yield Case(group, "all_data.json nested deep", INSPECT, write("scene/all_data.json", "[" * 100000))
    yield Case(group, "all_data.json: 5000 digits", INSPECT, write("scene/all_data.json", f"[{DIGITS * 13}]"))
    yield Case(group, "all_data.json: time of 400 digits", INSPECT, every(lambda r: r.update(time=int(DIGITS))))
    yield Case(group, "all_data.json: pose of 400 digits", INSPECT, every(digits_in_pose))
    yield Case(group, "all_data.json: file_path is a number", INSPECT, every(lambda r: r.update(file_path=3)))
    yield Case(group, "all_data.json: frame of 400 digits", INSPECT,
               listing(lambda rows: rows[-1].update(file_path=f"./data/r_0_{DIGITS}.png")))  # fmt: skip
    yield Case(group, "transforms.json: time of 400 digits", INSPECT,
               nerfstudio(lambda c: c["frames"][0].update(time=10**400)))  # fmt: skip
    yield Case(group, "transforms.json: matrix of 400 digits", INSPECT,
               nerfstudio(lambda c: c["frames"][0]["transform_matrix"][0].__setitem__(0, 10**400)))  # fmt: skip


def scenes() -> Iterator[Case]:
    group = "scenes"
    for command, how in ((INSPECT, "inspect"), (NEW, "reconstruct")):
        shown = how == "inspect"
        for name, change in (
            ("masks of frame 0 are empty", masks(255, frame="0")),
            ("masks of frame 0 are one pixel", masks(None, size=1, frame="0")),
            ("masks cover everything", masks(30)),
            ("one view", listing(lambda rows: of_view(0, rows))),
            ("a camera looks away", listing(looks_away)),
            ("poses in millimetres", every(millimetres)),
            ("ground metres above the object", scene_yaml("ground: {normal: [0, 1, 0], height: 5}\n")),
        ):
            yield Case(group, f"{name} ({how})", command, change, goes_on=shown)
    for name, change in (
        ("two identical cameras", listing(same_cameras)),
        ("principal point outside the picture", every(intrinsic(0, 2, 500.0))),
        ("last row of the intrinsics not 0 0 1", every(intrinsic(2, 0, 0.3))),
        ("skew below the diagonal", every(intrinsic(1, 0, 5.0))),
        ("focal length of 1e-3 pixels", every(intrinsic(0, 0, 1e-3))),
        ("1e-9 frames a second", every(rate(1e-9))),
        ("1e300 frames a second", every(rate(1e300))),
        ("scene.yaml: fps 1e300", scene_yaml("fps: 1.0e+300\n")),
        ("scene.yaml: fps 1e-9", scene_yaml("fps: 1.0e-9\n")),
        ("scene.yaml: density 1e300", scene_yaml("density: 1.0e+300\n")),
        ("scene.yaml: gravity 1e300", scene_yaml("gravity: 1.0e+300\n")),
        ("scene.yaml: ground at 1e300", scene_yaml("ground: {normal: [0, 1, 0], height: 1.0e+300}\n")),
        ("frame numbers are time stamps", time_stamps),
        ("pictures of 30000×30000 by their header", huge_pictures(30000, 30000)),
        ("pictures of 2³¹×2³¹ by their header", huge_pictures(2**31 - 1, 2**31 - 1)),
        ("pictures of 0×0 by their header", huge_pictures(0, 0)),
        ("a picture is cut", cut("scene/data/r_0_0.png")),
        ("a mask is cut", cut("scene/data/m_0_0.png", 0.3)),
    ):
        yield Case(group, name, INSPECT, change)
    yield Case(group, "a mask is a FIFO", INSPECT, pipe("scene/data/m_0_0.png"), goes_on=True)
    for name, change in (
        ("is a FIFO", lambda s: ((s / "cloud_1.ply").unlink(), os.mkfifo(s / "cloud_1.ply"))),
        ("is a time stamp", lambda s: os.rename(s / "cloud_1.ply", s / "cloud_1700000000.ply")),
        ("says 10¹² points", lambda s: (s / "cloud_0.ply").write_text(
            (s / "cloud_0.ply").read_text().replace("vertex 100", "vertex 1000000000000"))),
        ("is empty", lambda s: (s / "cloud_0.ply").write_text("")),
        ("has coordinates of 1e300", lambda s: (s / "cloud_0.ply").write_text(
            (s / "cloud_0.ply").read_text().replace("float", "double").replace("0.", "9e299 #")[:400])),
    ):  # fmt: skip
        yield Case(group, f"point cloud {name}", INSPECT, clouds(change))


def tracks() -> Iterator[Case]:
    group = "tracks"
    for name, change in (
        ("C3D cut after 60 %", c3d(0.6)),
        ("C3D cut after 10 %", c3d(0.1)),
        ("C3D of random bytes", lambda f: (c3d(1.0)(f), flip("tracks/drop.c3d")(f))),
        ("CSV with 1e300", table(ROWS.replace("0,0,1.0", "0,0,1e300"))),
        ("CSV with times of 1e300", table(ROWS.replace("0.39,", "1e300,"))),
        ("CSV with a 400-digit number", table(ROWS.replace("0,0,1.0", f"0,0,{DIGITS}"))),
        ("CSV is a FIFO", lambda f: (table(ROWS)(f), pipe("tracks/a.csv")(f))),
        ("CSV of NUL bytes", lambda f: (table(ROWS)(f), write("tracks/a.csv", b"\0" * 400)(f))),
        ("markers: []", table(ROWS, "{file: a.csv, markers: []}")),
        ("a marker without z", table(NO_Z)),
        ("medium_density 1e300", table(ROWS, more="medium_density: 1.0e+300\n")),
        ("mass 1e300", lambda f: (table(ROWS)(f), write("tracks/scene.yaml", (f / "tracks/scene.yaml").read_text()
                                                        .replace("mass: 1", "mass: 1.0e+300"))(f))),
        ("sphere of 1e300", lambda f: write("tracks/scene.yaml", (
            "layout: tracks\nbodies: {b: {density: 1, geometry: {units: m, sphere: 1.0e+300}}}\n"
            "runs: [{file: drops.csv, select: {ball: heavy, drop: 1}}]\n"))(f)),
        ("a run outside of time", table(ROWS, "{file: a.csv, time: [5, 6]}")),
        ("rest_frames of 400 digits", table(ROWS, f"{{file: a.csv, rest_frames: [0, {DIGITS}]}}")),
    ):  # fmt: skip
        yield Case(group, name, TRACKS, change)


def options() -> Iterator[Case]:
    group = "options"
    for name, command in (
        ("--law typo", "identify {scene} --out {out} --config {dir}/tiny.yaml --law typo"),
        ("--geometry-loss typo", "identify {scene} --out {out} --config {dir}/tiny.yaml --geometry-loss typo"),
        ("--arch typo", "inspect {scene} --arch typo --config {dir}/tiny.yaml"),
        ("--seed −1", "inspect {scene} --seed -1"),
        ("--seed of 400 digits", f"inspect {{scene}} --seed {DIGITS}"),
        ("--velocity=1e30,0,0", SIMULATE + " --velocity=1e30,0,0"),
        ("--velocity=nan,0,0", SIMULATE + " --velocity=nan,0,0"),
        ("--omega=1e30,0,0", SIMULATE + " --omega=1e30,0,0"),
        ("--gravity=1e30,0,0", SIMULATE + " --gravity=1e30,0,0"),
        ("--density 1e300", SIMULATE + " --density 1e300"),
        ("--density 1e-300", SIMULATE + " --density 1e-300"),
        ("--ground 1e300", SIMULATE + " --ground 1e300"),
        ("--ground −1e300", SIMULATE + " --ground=-1e300"),
        ("--force=1e300,0,0", SIMULATE + " --force=1e300,0,0"),
        ("--force-from nan", SIMULATE + " --force=1,0,0 --force-from nan"),
        ("--blend 7", SIMULATE + " --law {run} --blend 7"),
        ("--frames 10¹²", "simulate {run} --frames 1000000000000 --out {out}"),
        ("--frames of 400 digits", f"simulate {{run}} --frames {DIGITS} --out {{out}}"),
        ("--law NOT_A_RUN", SIMULATE + " --law {scene}"),
        ("--truth NOT_A_FOLDER", "evaluate {run} --truth {dir}/nowhere"),
        ("evaluate without --truth", "evaluate {run}"),
        ("identify --also NOT_A_RUN", "identify {scene} --out {out} --also {dir}/nowhere"),
    ):
        yield Case(group, name, command)
    for name, file, data in (
        ("text", "m.stl", "no mesh"),
        ("one triangle", "m.stl", CUBE + "endsolid\n"),
        ("empty", "m.ply", b""),
        ("a picture", "m.png", png_header(1, 1)),
        ("an .obj without faces", "m.obj", "v 0 0 0\nv 1 0 0\n"),
        ("an .stl that says 4·10⁹ faces", "m.stl", b"\0" * 80 + struct.pack("<I", 2**32 - 1)),
        ("an .obj with NaN", "m.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
    ):
        yield Case(group, f"--geometry: {name}", SIMULATE + f" --geometry {{dir}}/{file}", write(file, data))
    yield Case(group, "--geometry is a FIFO", SIMULATE + " --geometry {dir}/m.stl", pipe("m.stl"))
    yield Case(group, "--geometry is a folder without a run", SIMULATE + " --geometry {scene}")


def truths() -> Iterator[Case]:
    group = "truth of evaluate"
    for name, change, goes_on in (
        ("one file is empty", lambda gt: (gt / "particles_2.npy").write_bytes(b""), False),
        ("one array is empty", lambda gt: np.save(gt / "particles_0.npy", np.zeros((0, 3))), False),
        ("a NaN", lambda gt: np.save(gt / "particles_1.npy", np.load(gt / "particles_1.npy") * np.nan), False),
        ("of text", lambda gt: np.save(gt / "particles_0.npy", np.full((9, 3), "a")), False),
        ("complex", lambda gt: np.save(gt / "particles_0.npy", np.full((200, 3), 1j)), False),
        ("objects", lambda gt: np.save(gt / "particles_0.npy", np.array([{}], object), allow_pickle=True), False),
        ("of another scene", moved_truth, False),
        ("frame 2 is missing", lambda gt: (gt / "particles_2.npy").unlink(), False),
        ("the last frame is missing", lambda gt: (gt / "particles_3.npy").unlink(), True),
        ("of one particle", lambda gt: [np.save(p, np.load(p)[:1]) for p in gt.glob("*.npy")], False),
        ("a header of 10¹² rows", lambda gt: (gt / "particles_0.npy").write_bytes(
            b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 3), }"
            .ljust(117) + b"\n"), False),
    ):  # fmt: skip
        yield Case(group, name, EVALUATE, truth(change), goes_on=goes_on)


def outputs() -> Iterator[Case]:
    group = "--out"
    file = write("taken", "a file")
    for name, command, change in (
        ("below a file", "simulate {run} --frames 3 --out {dir}/taken/x", file),
        ("is a file", "simulate {run} --frames 3 --out {dir}/taken", file),
        ("below a file (reconstruct)", "reconstruct {scene} --out {dir}/taken/x --config {dir}/tiny.yaml", file),
        ("below a file (inspect)", "inspect {scene} --out {dir}/taken/x.png", file),
        ("a folder (inspect)", "inspect {scene} --out {scene}", file),
        ("below a file (synth)", "synth {dir}/spec.yaml --out {dir}/taken/x", spec()),
        ("in /proc", "simulate {run} --frames 3 --out /proc/masiv", file),
        ("in /proc (synth)", "synth {dir}/spec.yaml --out /proc/masiv", spec()),
        ("a name of 300 characters", "simulate {run} --frames 3 --out {dir}/" + "x" * 300, file),
        ("a name of 300 characters (synth)", "synth {dir}/spec.yaml --out {dir}/" + "x" * 300, spec()),
    ):
        change_all = (lambda c: lambda f: (file(f), c(f)))(change)
        yield Case(group, name, command, change_all)
    for disk, code in (("read-only", 2), ("full", 1)):
        for command in ("simulate {run} --frames 3 --out {disk}/x", "synth {dir}/spec.yaml --out {disk}/x",
                        "reconstruct {scene} --out {disk}/x --config {dir}/tiny.yaml",
                        "inspect {scene} --out {disk}/x.png"):  # fmt: skip
            yield Case(group, f"{disk} disk ({command.split()[0]})", command, spec(), code=code, disk=disk)


def syntheses() -> Iterator[Case]:
    group = "synth"
    for name, change in (
        ("density 1e300", spec(material={**SPEC["material"], "density": 1e300})),  # type: ignore[dict-item]
        ("fps 1e300", spec(fps=1e300)),
        ("fps 1e-9", spec(fps=1e-9)),
        ("velocity 1e30", spec(velocity=[1e30, 0, 0])),
        ("gravity 1e30", spec(gravity=[0, -1e30, 0])),
        ("size 1e300", spec(shape={"size": 1e300})),
        ("modulus 1e30", spec(material={"parameters": {"youngs_modulus": 1e30, "poissons_ratio": 0.3}})),
        ("Poisson's ratio 0.7", spec(material={"parameters": {"youngs_modulus": 1e4, "poissons_ratio": 0.7}})),
        ("an unknown law", spec(material={"law": "rubber", "parameters": {}})),
        ("a parameter of another law", spec(material={"parameters": {"viscosity": 3.0}})),
        ("an unknown effect", spec(effects={"magic": {}})),
        ("an effect out of bounds", spec(effects={"linear_drag": {"rate": -1e300}})),
        ("10⁹ frames", spec(frames=10**9)),
        ("10¹² particles", spec(particles=10**12)),
        ("a mesh that is text", lambda f: (spec(shape={"kind": "mesh", "mesh": "m.stl"})(f), write("m.stl", "x")(f))),
        ("cameras inside the body", spec(cameras={"count": 4, "size": 48, "distance": 0.01})),
        ("camera above its target", spec(cameras={"count": 4, "size": 48, "distance": 1e-9, "target": [0, 0, 0]})),
        ("a key twice", lambda f: write("spec.yaml", "fps: 24\nfps: 25\n")(f)),
    ):
        yield Case(group, name, SYNTH, change)


def cases() -> list[Case]:
    """All of them."""
    makers = (files_of_a_run, edited_by_hand, texts, scenes, tracks, options, truths, outputs, syntheses)
    return [case for maker in makers for case in maker()]
