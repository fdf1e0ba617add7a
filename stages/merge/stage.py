"""merge: join the parts that shards of one stage wrote into the artefact that one run would have written."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from schemas import ArtefactWriter, Schema, read_config
from schemas.checks import is_foreign
from schemas.command_line import whole_command
from schemas.files.outputs import Output
from stages.common.progress import Progress
from stages.merge.config import Config
from stages.merge.joining import join_paths, join_variable
from stages.merge.parts import Parts, open_parts, wants_geotiff
from stages.physics.maps.geotiff import write_geotiff
from stages.physics.maps.grid import read_grid


def work(parts: Sequence[Path], output: Output, config: Config, progress: Progress) -> Schema:
    """See :func:`stages.merge.run`."""
    with open_parts(parts) as opened:
        made_with = read_config(opened.files[0]) | {"shard": [0, 1]}
        as_geotiff = wants_geotiff(parts, config)
        provenance, inputs = _provenance(opened, output.file, config)
        seed = -1 if is_foreign(opened.files[0]) else int(opened.files[0].attrs.get("seed", -1))
        with ArtefactWriter(
            output.file,
            opened.schema,
            opened.sizes(),
            config=made_with,
            inputs=inputs,
            seed=None if seed < 0 else seed,
            attributes=opened.attributes(output.file) | provenance,
        ) as writer:
            if "crs" in opened.files[0]:
                opened.files[0].copy("crs", writer.file, "crs")
            for number, name in enumerate(opened.names):
                progress(number, len(opened.names), f"merging {name}")
                join_variable(opened, name, writer, config.virtual)
            join_paths(opened, writer.file, output.file)
            if as_geotiff:
                write_geotiff(output.geotiff_path, writer.file, read_grid(writer.file, output.file))
            progress(len(opened.names), len(opened.names), "merging")
        return opened.schema


def _provenance(parts: Parts, output: Path, config: Config) -> tuple[dict[str, Any], list[Path]]:
    """How the whole was made: root attributes that say so, and the inputs to record."""
    if config.inputs is not None:
        return {}, list(config.inputs)
    if not parts.of_one_run:
        return {}, parts.paths
    # The whole is what that run in one piece would have made, from the same inputs.
    first = parts.files[0].attrs
    attributes = {k: first[k] for k in ("inputs", "provenance", "folder") if k in first}
    attributes["command"] = whole_command(str(first.get("command", "")), output)
    attributes["parts"] = json.dumps([path.name for path in parts.paths])
    return attributes, []
