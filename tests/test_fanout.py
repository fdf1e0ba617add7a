"""Wide stages in parts: on a real Dask cluster that loses a worker, after interruptions, and by hand; always the same bytes."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import rasterio
from cluster_scene import assert_same, environment, finish, lunargr, stages, start
from command import outcome
from small_scene import write_scene

from schemas import PAIRS, SCENE, ArtefactError, ConfigError, InputError, atomic_path, open_artefact
from schemas.files.inputs import Inputs
from schemas.files.outputs import Output
from schemas.packing import read
from stages import infer, ingest, merge, project, sample
from stages.common.runner.job import Identity, open_job
from stages.ingest.stage import summarise


@pytest.fixture(scope="module")
def inputs(small_files, small_artefacts, small_checkpoint):
    """What the stages are run on: files, scene, crops, pairs, checkpoint."""
    return small_artefacts | {"dem": small_files.dem, "images": small_files.images, "checkpoint": small_checkpoint}


@pytest.fixture(scope="module")
def in_one_process(inputs, tmp_path_factory):
    """name -> what one uninterrupted process makes of it, made when first asked for."""
    folder, made = tmp_path_factory.mktemp("one"), {"project": inputs["pairs"]}

    def make(name):
        if name not in made:
            code, said = lunargr(*stages(inputs)[name], "-o", folder / f"{name}.h5")
            assert code == 0, said
            made[name] = folder / f"{name}.h5"
        return made[name]

    return make


class Cluster:
    """A scheduler and two workers, each a process of its own."""

    def __init__(self, folder):
        self.file = folder / "scheduler.json"
        self.folder = folder
        self.processes = [self._run("scheduler", "--port", "0", "--scheduler-file", self.file, "--no-dashboard")]
        self.workers = []
        while not self.file.exists():
            time.sleep(0.05)
        self.address = json.loads(self.file.read_text())["address"]

    def _run(self, what, *options):
        command = [sys.executable, "-m", "distributed.cli.dask_" + what, *map(str, options)]
        return subprocess.Popen(command, env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def fill(self):
        """Two workers that live."""
        self.workers = [w for w in self.workers if w.poll() is None]
        while len(self.workers) < 2:
            options = ["--no-nanny", "--nthreads", 1, "--no-dashboard", "--local-directory", self.folder]
            self.workers.append(self._run("worker", self.address, *options))
            self.processes.append(self.workers[-1])

    def kill_one_at_work(self, output, process):
        """SIGKILL the worker that is just writing a part of ``output``."""
        parts = output.with_name(f"{output.name}.parts")
        while process.poll() is None:
            for worker in self.workers:
                if list(parts.glob(f"*/.*partial-*-{worker.pid}-*")):
                    worker.send_signal(signal.SIGKILL)
                    worker.wait()
                    return
            time.sleep(0.001)
        raise AssertionError(finish(process))

    def close(self):
        for process in self.processes[::-1]:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    pytest.importorskip("distributed")
    made = Cluster(tmp_path_factory.mktemp("dask"))
    yield made
    made.close()


PARTS = {"ingest": 3, "sample": 4, "project": 6, "infer": 4}


def with_parts(name, inputs):
    return [*stages(inputs)[name], *(["--parts", PARTS[name]] if name in PARTS else [])]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ingest", "sample", "project", "infer", "evaluate"])
def test_a_worker_dies_and_nothing_is_lost(name, inputs, in_one_process, cluster, tmp_path):
    whole = in_one_process(name)
    cluster.fill()
    output = tmp_path / f"{name}.h5"
    process = start([*with_parts(name, inputs), "--scheduler", cluster.address, "-o", output])
    cluster.kill_one_at_work(output, process)
    code, said = finish(process)
    assert code == 0, said
    assert "Traceback" not in said
    assert_same(whole, output)
    with h5py.File(whole) as a, h5py.File(output) as b:
        assert a.attrs["inputs"] == b.attrs["inputs"]
    suffixes = {"infer": [".tif"], "evaluate": [".json"]}.get(name, [])
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([output.name, *(name + s for s in suffixes)])


@pytest.mark.slow
def test_workers_of_this_machine(inputs, in_one_process, tmp_path):
    pytest.importorskip("distributed")
    output = tmp_path / "pairs.h5"
    code, said = lunargr("project", inputs["crops"], "--scheduler", "local:2", "--parts", 4, "-o", output)
    assert code == 0, said
    assert_same(in_one_process("project"), output)


@pytest.mark.slow
def test_a_worker_s_error_is_one_line(inputs, cluster, tmp_path):
    """The error that one process would give, and no part that looks whole."""
    cluster.fill()
    table = tmp_path / "images.csv"
    folder = inputs["images"].parent
    text = inputs["images"].read_text()
    for k in range(3):
        text = text.replace(f"image{k}.tif", str(folder / f"image{k}.tif") if k != 1 else "broken.tif")
    table.write_text(text)
    (tmp_path / "broken.tif").write_text("no picture")
    command = ["ingest", inputs["dem"], "--images", table, "--gsd", 20, "--crop", 32, "-o", tmp_path / "s.h5"]
    code, said = lunargr(*command, "--scheduler", cluster.address, "--quiet")
    assert code == 3
    assert len(said.splitlines()) == 1 and "broken.tif" in said
    assert not (tmp_path / "s.h5").exists()


@pytest.mark.slow
def test_a_diagnosis_on_a_worker(inputs, cluster, tmp_path):
    cluster.fill()
    texts = []
    for name, where in (("here", []), ("there", ["--scheduler", cluster.address])):
        files = [tmp_path / f"{name}.h5", "--json", tmp_path / f"{name}.json", "--report", tmp_path / f"{name}.html"]
        few = ["--pairs", 12, "--causes", 1]
        code, said = lunargr("diagnose", inputs["pairs"], "--model", "M1", *few, *where, "--quiet", "-o", *files)
        assert code == 0, said
        texts.append(json.loads((tmp_path / f"{name}.json").read_text()))
    assert texts[0] == texts[1] and texts[0]["verdict"]
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        f"{n}{s}" for n in ("here", "there") for s in (".h5", ".html", ".json")
    ]
    assert_same(tmp_path / "here.h5", tmp_path / "there.h5")


def test_schedulers_that_are_not_there(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    from stages.common.runner import engines

    monkeypatch.setattr(engines, "ANSWER_WITHIN", 1.0)
    for where in ("tcp://127.0.0.1:9", "nonsense"):
        with pytest.raises(ConfigError, match="`scheduler`: ") as caught, engines.open_dask(where, tmp_path):
            pass
        assert "\n" not in str(caught.value) and "local:N" in str(caught.value)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match=r"lunargr\[cluster\]"), engines.open_dask("local:2", tmp_path):
        pass


def interrupt(command, output, how, finished=2):
    """Stop a run when ``finished`` of its parts are there; what it said."""
    parts = output.with_name(f"{output.name}.parts")
    process = start(command)
    while len([p for p in parts.glob("*/*-of-*.h5") if not p.name.startswith(".")]) < finished:
        assert process.poll() is None, finish(process)
        time.sleep(0.002)
    process.send_signal(how)
    return finish(process)


@pytest.mark.parametrize(
    "how", [signal.SIGKILL, *(pytest.param(s, marks=pytest.mark.slow) for s in (signal.SIGINT, signal.SIGTERM))]
)
def test_an_interrupted_run_goes_on_with_what_is_missing(inputs, in_one_process, tmp_path, how):
    output = tmp_path / "pairs.h5"
    command = ["project", inputs["crops"], "--resume", "--parts", 6, "-o", output]
    code, said = interrupt(command, output, how)
    assert code == {signal.SIGINT: 130, signal.SIGKILL: -9, signal.SIGTERM: 143}[how]
    assert "Traceback" not in said
    assert not output.exists()
    code, said = outcome(*command)
    assert code == 0 and "of 6 parts are there already" in said, said
    assert_same(in_one_process("project"), output)
    assert [p.name for p in tmp_path.iterdir()] == ["pairs.h5"]


@pytest.mark.slow
def test_parts_of_another_command_are_not_used(inputs, in_one_process, tmp_path):
    output = tmp_path / "pairs.h5"
    interrupt(["project", inputs["crops"], "--resume", "--parts", 5, "-o", output], output, signal.SIGKILL)
    code, said = lunargr("project", inputs["crops"], "--resume", "--parts", 6, "-o", output)
    assert code == 0 and "already" not in said
    assert_same(in_one_process("project"), output)


def test_a_refused_run_makes_nothing_and_is_refused_again(tmp_path):
    """The second time, too: a continuation replaces only what its own earlier run recorded."""
    (tmp_path / "map.tif").write_text("somebody's own")
    files = [tmp_path / "scene.h5", tmp_path / "checkpoint.h5"]  # a refused run reads neither
    for path in files:
        path.write_text("")
    for _ in range(2):
        with pytest.raises(ConfigError, match=r"map\.tif: exists already"):
            infer.run(*files, Output(tmp_path / "map.h5", resume=True, parts=2), infer.Config())
        assert sorted(p.name for p in tmp_path.iterdir()) == ["checkpoint.h5", "map.tif", "scene.h5"]
    assert (tmp_path / "map.tif").read_text() == "somebody's own"


def write_part(path, fail=False):
    with atomic_path(path) as partial:
        partial.write_text("part")
    if fail:
        raise InputError("the second part fails")


def make_text(output, version=1, fail=False):
    """A job of two parts, each a file of text."""
    with open_job(Output(output), Identity("text", {"version": version}, [])) as job:
        parts = job.fan("text", write_part, [{}, {"fail": fail}], ".txt")
        output.write_text("".join(p.read_text() for p in parts))


@pytest.mark.parametrize("place", ["note.txt", "photographs/first.tif", "{job}/note.txt"])
def test_a_folder_of_parts_with_other_files_is_refused_and_stays(tmp_path, place):
    output, parts = tmp_path / "x.txt", tmp_path / "x.txt.parts"
    with pytest.raises(InputError):
        make_text(output, fail=True)
    [job] = [p.name for p in parts.iterdir() if p.is_dir()]
    own = parts / place.format(job=job)
    own.parent.mkdir(exist_ok=True)
    own.write_text("somebody's own")
    before = sorted(parts.rglob("*"))
    for version in (1, 2):  # the same job, and another one, which throws parts away
        with pytest.raises(ConfigError, match="found a file that no run made"):
            make_text(output, version)
    assert sorted(parts.rglob("*")) == before
    own.unlink()
    if "photographs" in place:
        own.parent.rmdir()
    make_text(output, version=2)
    assert [p.name for p in tmp_path.iterdir()] == ["x.txt"]


def test_a_file_put_among_the_parts_of_a_run_stays(tmp_path):
    output = tmp_path / "x.txt"
    with open_job(Output(output), Identity("text", {}, [])) as job:
        job.fan("text", write_part, [{}], ".txt")
        (job.folder / "note.txt").write_text("somebody's own")
    assert [p.name for p in (tmp_path / "x.txt.parts").rglob("*") if p.is_file()] == ["note.txt"]


@pytest.mark.slow
def test_a_plain_run_after_a_kill_starts_anew_and_ends_the_same(inputs, in_one_process, tmp_path):
    output = tmp_path / "map.h5"
    command = [*stages(inputs)["infer"], "-o", output]
    process = start(command)
    while not list(tmp_path.glob(".map.h5.partial-*")):
        assert process.poll() is None, finish(process)
        time.sleep(0.002)
    process.kill()
    finish(process)
    assert not output.exists()
    code, said = lunargr(*command)
    assert code == 0, said
    assert_same(in_one_process("infer"), output)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["map.h5", "map.tif"]


# --- by hand: shards and merge --------------------------------------------------------------------------------------


@dataclass
class ByHand:
    """A scene in one piece, and its parts: rows of the DEM, the grid that they make, and shares of the images."""

    whole: Path
    rows: list[Path]
    grid: Path
    images: list[Path]


@pytest.fixture(scope="module")
def by_hand(small_files, tmp_path_factory):
    folder, config = tmp_path_factory.mktemp("by_hand"), ingest.Config(gsd=20, crop=32, block=64)
    rows, images = [folder / f"{k}" / "rows.h5" for k in range(3)], [folder / f"images{k}.h5" for k in range(2)]
    made = ByHand(folder / "whole.h5", rows, folder / "grid.h5", images)
    ingest.run(small_files.dem, small_files.images, made.whole, config)
    for k, part in enumerate(rows):
        ingest.run(small_files.dem, None, part, replace(config, shard=(k, 3)))
    merge.run(rows, made.grid, merge.Config(virtual=True))
    for k, part in enumerate(images):
        ingest.run(made.grid, small_files.images, part, ingest.Config(crop=32, block=64, shard=(k, 2)))
    return made


@pytest.mark.parametrize("virtual", [False, True])
def test_a_scene_by_hand_is_a_dem_in_rows_and_then_its_images(by_hand, virtual):
    for part in by_hand.images:
        assert part.stat().st_size < 0.7 * by_hand.whole.stat().st_size  # no elevations of its own
    scene = by_hand.whole.with_name(f"scene_{virtual}.h5")  # a virtual file lies beside its parts
    merge.run(by_hand.images, scene, merge.Config(virtual))
    assert_same(by_hand.whole, scene)
    found, whole = summarise(scene), summarise(by_hand.whole)
    assert (found.elevation_range, found.dem_valid_share) == (whole.elevation_range, whole.dem_valid_share)


def test_images_cannot_be_shared_out_before_the_dem(small_files, tmp_path):
    with pytest.raises(ConfigError, match="the DEM comes first"):
        ingest.run(small_files.dem, small_files.images, tmp_path / "x.h5", ingest.Config(gsd=20, shard=(0, 2)))


def _blank(dem, *where):
    """Put nodata into parts of a DEM."""
    with rasterio.open(dem, "r+") as file:
        heights = file.read(1)
        for part in where:
            heights[part] = file.nodata
        file.write(heights, 1)


def test_rows_on_nodata_are_a_part_like_any_other(tmp_path):
    files = write_scene(tmp_path / "files", images=1)
    _blank(files.dem, np.s_[:200])
    config = ingest.Config(gsd=20, crop=32, block=64)
    ingest.run(files.dem, None, tmp_path / "whole.h5", config)
    parts = [tmp_path / f"{k}.h5" for k in range(8)]  # of six rows of blocks: two have no rows, three lie on nodata
    found = [ingest.run(files.dem, None, part, replace(config, shard=(k, 8))) for k, part in enumerate(parts)]
    assert [f.dem_valid_share > 0 for f in found] == [False] * 5 + [True] * 3
    merge.run(parts, tmp_path / "merged.h5")
    ingest.run(files.dem, None, Output(tmp_path / "fanned.h5", resume=True, parts=3), config)
    for name in ("merged", "fanned"):
        assert_same(tmp_path / "whole.h5", tmp_path / f"{name}.h5")
    assert summarise(tmp_path / "merged.h5") == summarise(tmp_path / "whole.h5")
    _blank(files.dem, np.s_[::2], np.s_[:, ::2])  # a quarter of each pixel of 40 m is known: too little for a mean
    for k in range(2):
        ingest.run(files.dem, None, Output(parts[k], overwrite=True), replace(config, gsd=40, shard=(k, 2)))
    with pytest.raises(InputError, match="only nodata"):
        merge.run(parts[:2], tmp_path / "nothing.h5")
    assert not (tmp_path / "nothing.h5").exists()


def test_more_parts_than_pairs(tmp_path):
    """The first part of one pair in two is empty, and still says what the images hold."""
    files = write_scene(tmp_path / "files", images=1, gain=[(100, 3)])
    ingest.run(files.dem, files.images, tmp_path / "scene.h5", ingest.Config(gsd=20, crop=32))
    settings = sample.Config(count=1, tile_m=1280)
    sample.run(tmp_path / "scene.h5", tmp_path / "crops.h5", settings)
    for k in range(2):
        sample.run(tmp_path / "scene.h5", tmp_path / f"crops{k}.h5", replace(settings, shard=(k, 2)))
        project.run(tmp_path / "crops.h5", tmp_path / f"pairs{k}.h5", project.Config(shard=(k, 2)))
    project.run(tmp_path / "crops.h5", tmp_path / "pairs.h5", project.Config())
    for name in ("crops", "pairs"):
        merge.run([tmp_path / f"{name}{k}.h5" for k in range(2)], tmp_path / "merged.h5")
        assert_same(tmp_path / f"{name}.h5", tmp_path / "merged.h5")
        (tmp_path / "merged.h5").rename(tmp_path / f"merged_{name}.h5")
    with open_artefact(tmp_path / "merged_pairs.h5", PAIRS) as file:
        assert len(file["image"]) == 1 and file["image"].attrs["units"] == "dn"


def test_a_scene_names_its_dem_from_wherever_it_lies(by_hand, small_files):
    """Its shards may lie in folders of their own, and the whole in another."""
    for scene in (*by_hand.rows, by_hand.grid, *by_hand.images):
        assert Inputs([scene]).find(small_files.dem) is not None, scene


def test_a_view_says_so_when_a_part_is_gone(small_artefacts, tmp_path):
    (tmp_path / "parts").mkdir()
    parts = [tmp_path / "parts" / f"{k}.h5" for k in range(3)]
    for k, part in enumerate(parts):
        project.run(small_artefacts["crops"], part, project.Config(shard=(k, 3)))
    code, said = outcome("merge", *parts, "--virtual", "-o", tmp_path / "pairs.h5")
    assert code == 0, said
    assert_same(small_artefacts["pairs"], tmp_path / "pairs.h5")
    with h5py.File(tmp_path / "pairs.h5") as file:
        assert file["image"].is_virtual
        assert np.isfinite(read(file["elevation"], -1)).all()
    assert (tmp_path / "pairs.h5").stat().st_size < 0.2 * small_artefacts["pairs"].stat().st_size
    parts[1].unlink()
    with pytest.raises(ArtefactError, match=r"parts/1\.h5"):
        open_artefact(tmp_path / "pairs.h5", PAIRS)


def test_a_view_of_a_map_leaves_the_geotiff_to_a_copy(hilly_map, tmp_path):
    parts = [tmp_path / f"{k}.h5" for k in range(2)]
    for k, part in enumerate(parts):
        shutil.copy(hilly_map[0], part)
        with h5py.File(part, "r+") as file:
            file.attrs["shard_rows"] = [80 * k, 80 * k + 80]  # of 160
            file.attrs["config"] = json.dumps({"shard": [k, 2]})
    merge.run(parts, tmp_path / "view.h5", merge.Config(virtual=True))
    assert_same(hilly_map[0], tmp_path / "view.h5")
    assert not (tmp_path / "view.tif").exists()
    merge.run(parts, tmp_path / "copy.h5")
    assert (tmp_path / "copy.tif").exists()


def test_merging_keeps_masks_sparse(by_hand, tmp_path):
    """A merged scene is no larger than one that was made in one piece: chunks without a value stay unwritten."""
    merge.run(by_hand.images, tmp_path / "scene.h5")
    with open_artefact(tmp_path / "scene.h5", SCENE) as a, open_artefact(by_hand.whole, SCENE) as b:
        assert a["valid"].id.get_num_chunks() == b["valid"].id.get_num_chunks()


def test_shards_and_parts_do_not_mix(inputs, tmp_path):
    whole, shard = project.Config(), project.Config(shard=(0, 2))
    for output, config, words in (
        (Output(tmp_path / "x.h5", resume=True), shard, "one part by hand"),
        (Output(tmp_path / "x.h5", parts=3), whole, "`parts`: expected"),
        (Output(tmp_path / "x.h5", scheduler="local:none"), whole, "`scheduler`: expected an address, or local:N"),
    ):
        with pytest.raises(ConfigError, match=words):
            project.run(inputs["crops"], output, config)
    assert not list(tmp_path.iterdir())
