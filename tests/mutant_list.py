"""The bugs that `make mutants` plants: each replaces one piece of text and names the fewest tests that should notice."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Mutant:
    """file, before, after : what is replaced, by what; tests : of pytest, that fail then; bug : what goes wrong, in words"""

    file: str
    before: str
    after: str
    tests: tuple[str, ...]
    bug: str


LEAKS = "tests/test_leaks.py"
ALL = "np.arange(reader.count)"

# What outside checks planted and the tests of that time did not notice.
KNOWN = (
    Mutant(
        "stages/diagnose/stage.py",
        "test = np.flatnonzero(reader.split == 2)",
        "test = np.flatnonzero(reader.split != 2)",
        ("tests/test_diagnose_leaks.py::test_the_score_is_of_the_test_pairs",),
        "the diagnosis is scored on the pairs that it learned from",
    ),
    Mutant(
        "stages/diagnose/stage.py",
        "train = np.flatnonzero(reader.split != 2)",
        "train = np.arange(reader.count)",
        ("tests/test_diagnose_leaks.py::test_causes_are_learned_without_the_test_pairs",),
        "the diagnosis learns from the test pairs, too",
    ),
    Mutant(
        "stages/diagnose/likelihood/weigh.py",
        "found.p = (1 + float((largest >= found.surprise).sum())) / (1 + len(largest))",
        "found.p = 0.0",
        ("tests/test_diagnose_leaks.py::test_p_tells_what_was_planted_from_what_was_not",),
        "every p of the diagnosis is 0",
    ),
    Mutant(
        "stages/train/stage.py",
        "history.objective.append(objective if math.isfinite(objective) else train_loss)",
        "history.objective.append(train_loss)",
        (f"{LEAKS}::test_the_best_epoch_is_that_of_the_lowest_validation_loss",),
        "the best epoch is chosen by the training loss",
    ),
    Mutant(
        "stages/train/training.py",
        "elevation_scale(reader, train))",
        f"elevation_scale(reader, {ALL}))",
        (f"{LEAKS}::test_test_pairs_change_nothing_of_a_checkpoint",),
        "the elevation scale is taken from all parts of the split",
    ),
    Mutant(
        "stages/train/training.py",
        "fit_start(reader, train, model, config.positive)",
        f"fit_start(reader, {ALL}, model, config.positive)",
        (f"{LEAKS}::test_test_pairs_change_nothing_of_a_checkpoint",),
        "training starts at the best uniform surface of all parts of the split",
    ),
    Mutant(
        "stages/network/uniform.py",
        "            radiometry = fit_radiometry(reader, indices, model, start)",
        f"            radiometry = fit_radiometry(reader, {ALL}, model, start)",
        (f"{LEAKS}::test_test_pairs_change_nothing_of_a_checkpoint",),
        "gains and offsets are fitted on all parts of the split",
    ),
    Mutant(
        "stages/train/stage.py",
        "predictor, training.radiometry, reader, train, validation, extensions",
        'predictor, training.radiometry, reader, train, reader.indices("test"), extensions',
        (f"{LEAKS}::test_test_pairs_change_nothing_of_a_checkpoint",),
        "the deviations' factor is chosen on test ground",
    ),
    Mutant(
        "stages/evaluate/fitting.py",
        "train = np.flatnonzero(split == 0)",
        "train = np.arange(len(split))",
        (f"{LEAKS}::test_baselines_are_fitted_on_training_pairs_alone",),
        "the baselines are fitted on all parts of the split",
    ),
    Mutant(
        "stages/evaluate/fitting.py",
        "train = np.flatnonzero(split == 0)",
        "train = np.flatnonzero(split <= 1)",
        (f"{LEAKS}::test_baselines_are_fitted_on_training_pairs_alone",),
        "the baselines are fitted on validation ground too",
    ),
    Mutant(
        "stages/common/intervals.py",
        "    ratio = ratio_interval(ours, other, unit, LOG)\n",
        "    first, second = (ratio_interval(v, np.ones(np.shape(v)[-1]), unit, LOG) for v in (ours, other))\n"
        "    ratio = Interval(first.value / second.value, first.low / second.high, first.high / second.low)\n",
        ("tests/test_intervals.py::test_a_gain_is_paired",),
        "the intervals of gains are not paired",
    ),
    Mutant(
        "stages/evaluate/comparison.py",
        "    unit, name = choose_units(tile, site)\n    frames",
        "    unit, name = np.arange(len(tile)), 'tile'\n    frames",
        ("tests/test_evaluate.py::test_tiles_are_the_witnesses_and_rows_are_paired_by_them",),
        "crops count as independent, not tiles",
    ),
    Mutant(
        "stages/effects/curvature_albedo.py",
        "(1 + self.value(",
        "(1 - self.value(",
        ("tests/test_effects.py::test_albedo_that_follows_curvature_is_high_in_hollows_where_its_strength_is_above_0",),
        "albedo follows curvature with the wrong sign",
    ),
    Mutant(
        "stages/effects/filters.py",
        "(ring - 4 * centre)",
        "(4 * centre - ring)",
        ("tests/test_effects.py::test_curvature_of_a_paraboloid",),
        "curvature has the wrong sign",
    ),
    Mutant(
        "stages/evaluate/core.py",
        "ssim(*crop, data_range=ranges[b])",
        "ssim(*crop, data_range=1.0)",
        ("tests/test_evaluate.py::test_ssim_takes_the_range_of_the_measured_crop",),
        "SSIM is taken with a range of 1",
    ),
)

PHYSICS = (
    Mutant(
        "stages/physics/photometry/quantities.py",
        "    return radiance_factor / math.pi\n",
        "    return radiance_factor\n",
        ("tests/test_photometry.py::test_quantities_go_there_and_back",),
        "bidirectional reflectance lacks a factor of pi",
    ),
    Mutant(
        "stages/physics/photometry/lambert.py",
        "* angles.cos_incidence\n",
        "* angles.cos_emission\n",
        ("tests/test_photometry.py::test_lambert_and_lommel_seeliger_in_closed_form",),
        "Lambert's law takes the emission angle for the incidence angle",
    ),
    Mutant(
        "stages/physics/photometry/lommel_seeliger.py",
        "        mu0 = angles.cos_incidence\n",
        "        mu0 = angles.cos_emission\n",
        ("tests/test_photometry.py::test_lambert_and_lommel_seeliger_in_closed_form",),
        "Lommel-Seeliger's law has mu in the place of mu0",
    ),
    Mutant(
        "stages/physics/photometry/lunar_lambert.py",
        "    g = torch.rad2deg(phase)\n",
        "    g = phase\n",
        ("tests/test_photometry.py::test_lunar_lambert_between_its_two_laws", "tests/test_photometry_oracles.py"),
        "McEwen's L(g) takes radians for degrees",
    ),
    Mutant(
        "stages/physics/photometry/hapke.py",
        "return hs / (hs + tan_half_phase)",
        "return hs / (hs + 2 * tan_half_phase)",
        ("tests/test_photometry.py::test_opposition_terms_at_their_limits", "tests/test_photometry_oracles.py"),
        "shadow hiding is half as wide",
    ),
    Mutant(
        "stages/physics/photometry/hapke.py",
        "((1 + c) * backward + (1 - c) * forward)",
        "((1 - c) * backward + (1 + c) * forward)",
        ("tests/test_photometry_oracles.py",),
        "the lobes of the phase function change places",
    ),
    Mutant(
        "stages/physics/formation/geometry.py",
        "    cos_incidence = (sz - slope_east * sx - slope_north * sy) * inverse\n",
        "    cos_incidence = (sz + slope_east * sx - slope_north * sy) * inverse\n",
        ("tests/test_formation.py::test_one_pass_gives_what_the_chain_gives",),
        "the normal leans the wrong way in the chain",
    ),
    Mutant(
        "stages/physics/formation/facets.py",
        "q = (above[j] - below[j]) * step - bend",
        "q = (below[j] - above[j]) * step - bend",
        ("tests/test_formation.py::test_one_pass_gives_what_the_chain_gives",),
        "rows run north in the fused geometry",
    ),
    Mutant(
        "stages/physics/formation/geometry.py",
        "return slope_east - east / body_radius",
        "return slope_east + east / body_radius",
        ("tests/test_formation.py::test_one_pass_gives_what_the_chain_gives",),
        "the body is hollow: its curvature tilts slopes the wrong way",
    ),
    Mutant(
        "stages/physics/maps/grid.py",
        "GDAL_CENTRE = 0.5 ",
        "GDAL_CENTRE = 0.0 ",
        ("tests/test_formats.py::test_the_first_pixel_lies_half_a_pixel_within_the_corner",),
        "pixel centres are taken for pixel corners, half a pixel off",
    ),
    Mutant(
        "stages/physics/maps/grid.py",
        "        east = np.cross(north, up)\n",
        "        east = np.cross(up, north)\n",
        ("tests/test_project.py::test_sun_and_camera_follow_spherical_trigonometry",),
        "east points west in local frames",
    ),
    Mutant(
        "stages/physics/maps/grid.py",
        "moved = self.transform @ Affine.translation(col, row)",
        "moved = self.transform @ Affine.translation(row, col)",
        ("tests/test_formats.py::test_the_first_pixel_lies_half_a_pixel_within_the_corner",),
        "rows and columns change places in windows of a grid",
    ),
    Mutant(
        "stages/physics/horizon/sweeps.py",
        "east, north = math.sin(azimuth) / east_size, math.cos(azimuth) / south_size",
        "east, north = -math.sin(azimuth) / east_size, math.cos(azimuth) / south_size",
        ("tests/test_horizon.py::test_wall",),
        "azimuths of the horizon run counter-clockwise",
    ),
    Mutant(
        "stages/physics/horizon/sweeps.py",
        "    return sinks[0] * d * d\n",
        "    return 0.0 * sinks[0] * d * d\n",
        ("tests/test_horizon.py::test_curvature_hides_a_distant_peak",),
        "terrain does not sink with distance",
    ),
    Mutant(
        "stages/physics/horizon/sweeps.py",
        "            1 / max(abs(east), abs(north)),\n",
        "            1.0,\n",
        ("tests/test_horizon.py::test_dome",),
        "a step along an oblique ray is as long as one along a row",
    ),
    Mutant(
        "stages/physics/horizon/scene.py",
        "y = (row + r - north * distance - 0.5 * (cell - 1)) / cell",
        "y = (row + r + north * distance - 0.5 * (cell - 1)) / cell",
        (
            "tests/test_horizon_scene.py::test_a_distant_wall_is_found_through_the_overview",
            "tests/test_horizon_scene.py::test_crops_see_the_whole_scene",
        ),
        "the far terrain is looked for in the opposite direction",
    ),
    Mutant(
        "stages/physics/images/orthorectify.py",
        "* (terrain.grid.radius + height)[..., None]",
        "* (terrain.grid.radius + 0 * height)[..., None]",
        ("tests/test_orthorectify.py::test_a_pattern_on_the_terrain_is_put_back",),
        "orthorectification ignores the heights",
    ),
    Mutant(
        "stages/physics/images/orthorectify.py",
        "np.meshgrid(np.arange(height + 1) + row - 0.5, np.arange(width + 1) + col - 0.5",
        "np.meshgrid(np.arange(height + 1) + row, np.arange(width + 1) + col - 0.5",
        ("tests/test_orthorectify.py::test_an_aligned_image_comes_back_as_block_means",),
        "orthorectified images are half a pixel off",
    ),
    Mutant(
        "stages/physics/images/orthorectify.py",
        "            if ground > height:",
        "            if ground < height - 1e9:",
        ("tests/test_orthorectify.py::test_a_wall_hides_what_lies_behind_it",),
        "nothing hides anything from a camera",
    ),
    Mutant(
        "stages/physics/images/correlation.py",
        "np.fft.irfft2(first * np.conj(second), shape)[lags]",
        "np.fft.irfft2(np.conj(first) * second, shape)[lags]",
        ("tests/test_registration.py::test_planted_shifts_come_back",),
        "registration finds shifts of the opposite sign",
    ),
    Mutant(
        "stages/physics/images/orthorectify.py",
        "row, col = row + dy, col + dx",
        "row, col = row - dy, col - dx",
        ("tests/test_cameras_registration.py", "tests/test_registration_frame.py"),
        "what registration finds is put on instead of taken off",
    ),
    Mutant(
        "stages/physics/images/displacement.py",
        "end = camera + (-along - np.sqrt(root))",
        "end = camera + (-along + np.sqrt(root))",
        (
            "tests/test_registration_field.py::test_relief_displacement_is_height_times_tangent_of_emission_away_from_the_camera",
        ),
        "the relief displacement is looked up on the far side of the body",
    ),
)

STAGES = (
    Mutant(
        "stages/physics/maps/rasters.py",
        "    result[invalid] = np.nan\n    return result",
        "    result[invalid] = 0.0\n    return result",
        (
            "tests/test_ingest.py::test_scene_holds_the_dem_on_its_own_grid",
            "tests/test_formats.py::test_nodata_in_its_spellings",
        ),
        "nodata counts as 0",
    ),
    Mutant(
        "stages/ingest/elevation.py",
        "np.where(enough, total / np.maximum(count, 1), np.nan)",
        "np.where(enough, total / (factor * factor), np.nan)",
        ("tests/test_ingest.py::test_integer_factor_is_the_area_mean_of_valid_pixels",),
        "area means count unknown pixels as 0 m",
    ),
    Mutant(
        "stages/physics/maps/positions.py",
        "    half = crop // 2\n",
        "    half = crop // 2 - 1\n",
        ("tests/test_ingest.py::test_valid_positions_are_exactly_those_of_whole_crops",),
        "crops may reach one pixel beyond valid data",
    ),
    Mutant(
        "stages/physics/maps/ground_tiles.py",
        "r0, r1 = (row - half) // self.edge, (row + half - 1) // self.edge",
        "r0, r1 = (row - half) // self.edge, (row + half - 2) // self.edge",
        ("tests/test_sample.py::test_a_footprint_ends_where_its_tile_does",),
        "crops reach one row into the next tile's ground",
    ),
    Mutant(
        "stages/physics/maps/ground_tiles.py",
        'f"{seed} {row} {col}".encode()',
        'f"{row} {col}".encode()',
        ("tests/test_sample.py::test_other_options_of_the_split_are_another_split",),
        "the split does not hang on the seed",
    ),
    Mutant(
        "stages/physics/maps/ground_tiles.py",
        "same & (one_tile | (corner == 0))",
        "same",
        ("tests/test_sample.py::test_crops_that_are_scored_lie_in_one_tile",),
        "test crops lie across tiles",
    ),
    Mutant(
        "stages/project/stage.py",
        "mean, radius, frame.sun_position(), frame.camera_position(radius))",
        "mean, radius, frames[0].sun_position(), frame.camera_position(radius))",
        ("tests/test_project.py::test_every_crop_has_the_sun_and_the_camera_of_its_own_image",),
        "crops get the Sun of another image",
    ),
    Mutant(
        "stages/project/stage.py",
        "mean, radius, frame.sun_position(), frame.camera_position(radius))",
        "mean, radius, frame.sun_position(), frames[-1].camera_position(radius))",
        ("tests/test_project.py::test_every_crop_has_the_sun_and_the_camera_of_its_own_image",),
        "crops get the camera of another image",
    ),
    Mutant(
        "stages/physics/horizon/scene.py",
        "    strip = np.ascontiguousarray(elevation[top:bottom, left:right], dtype=np.float32)\n",
        "    top, bottom, left, right = row, row + height, col, col + width\n"
        "    strip = np.ascontiguousarray(elevation[top:bottom, left:right], dtype=np.float32)\n",
        ("tests/test_project.py::test_terrain_outside_the_crop_casts_its_shadow",),
        "only the crop's own terrain casts near shadows",
    ),
    Mutant(
        "stages/project/stage.py",
        "        math.atan2(east, north) % (2 * math.pi),",
        "        math.atan2(north, east) % (2 * math.pi),",
        ("tests/test_project.py::test_terrain_outside_the_crop_casts_its_shadow",),
        "the horizon is taken towards a Sun counted from east",
    ),
    Mutant(
        "stages/network/losses.py",
        "return residual * (2 * gradients[0]), None, None",
        "return residual * gradients[0], None, None",
        ("tests/test_network.py::test_the_gradient_of_the_loss_is_that_of_its_value",),
        "gradients are half as large",
    ),
    Mutant(
        "stages/train/epoch.py",
        "    training.predictor.eval()\n    totals, pixels",
        "    training.predictor.train()\n    totals, pixels",
        (f"{LEAKS}::test_validation_runs_without_dropout_and_leaves_the_network_as_it_is",),
        "validation runs in training mode",
    ),
    Mutant(
        "stages/pairs/reader.py",
        "            o.sun_direction[k] = turn_vector(o.sun_direction[k].clone(), int(symmetry))\n",
        "",
        ("tests/test_network.py::test_turned_batches_render_as_turned_images",),
        "augmentation turns the image and not the Sun",
    ),
    Mutant(
        "stages/pairs/symmetries.py",
        "        east, north = -north, east\n",
        "        east, north = north, -east\n",
        ("tests/test_network.py::test_rendering_commutes_with_the_symmetries",),
        "augmentation turns vectors the wrong way",
    ),
    Mutant(
        "stages/train/epoch.py",
        "error.detach().double(), pixels])\n",
        "error.detach().double(), torch.ones_like(pixels)])\n",
        ("tests/test_train.py::test_the_losses_are_means_over_valid_pixels",),
        "the training loss is a sum and not a mean over pixels",
    ),
    Mutant(
        "stages/network/steps.py",
        "    order = rng.permutation(train)\n",
        "    order = rng.permutation(train)[1:]\n",
        ("tests/test_train.py::test_an_epoch_shows_every_training_pair_once",),
        "an epoch leaves out a pair",
    ),
    Mutant(
        "stages/network/cpu/strips.py",
        "self.x0 = max(0, (self.col - net.reach) // stride * stride)",
        "self.x0 = max(0, (self.col - net.reach // 2) // stride * stride)",
        ("tests/test_strips.py",),
        "strips have too little context: seams",
    ),
    Mutant(
        "stages/infer/windows.py",
        "weight = np.minimum(weight, (last - position) / overlap)",
        "weight = np.minimum(weight, 1.0)",
        ("tests/test_infer.py::test_weights_of_neighbouring_windows_add_up_to_one",),
        "windows are blended on one side only: seams",
    ),
    Mutant(
        "stages/pairs/holes.py",
        "    return np.where(valid, elevation, (filled * FILL_STEP).astype(np.float32))",
        "    return np.where(valid, elevation, np.float32(0))",
        ("tests/test_network.py::test_holes_continue_the_terrain_around_them",),
        "holes of the DEM are filled with 0 m",
    ),
    Mutant(
        "stages/infer/writing.py",
        "            values[:, ~mask] = np.nan\n",
        "            pass\n",
        ("tests/test_infer.py::test_nodata_is_masked_and_never_spread",),
        "the map holds coefficients where there is no terrain",
    ),
    Mutant(
        "stages/infer/stage.py",
        "writer.write_crs(grid.crs_wkt, grid.transform)",
        "writer.write_crs(grid.crs_wkt, grid.window(0, 1, 1, 1).transform)",
        ("tests/test_infer.py::test_the_georeference_is_that_of_the_coordinates",),
        "the map lies one pixel to the east",
    ),
    Mutant(
        "stages/physics/maps/geotiff.py",
        'else {"transform": self.grid.transform, ',
        'else {"transform": self.grid.window(0, 1, 1, 1).transform, ',
        ("tests/test_infer.py::test_geotiff_aligns_with_the_dem_and_says_what_it_holds",),
        "the GeoTIFF lies one pixel off",
    ),
    Mutant(
        "stages/evaluate/metrics.py",
        "np.where(valid, measured.astype(np.float64) - rendered, 0.0)",
        "measured.astype(np.float64) - rendered",
        ("tests/test_evaluate_metrics.py::test_squared_error_counts_valid_pixels_only",),
        "invalid pixels count in the squared error",
    ),
    Mutant(
        "stages/evaluate/metrics.py",
        "10 * np.log10(",
        "20 * np.log10(",
        ("tests/test_evaluate_metrics.py::test_psnr_of_known_errors",),
        "PSNR is twice as large",
    ),
    Mutant(
        "stages/evaluate/core.py",
        "crop_range(batch.image, batch.usable)",
        "crop_range(batch.image, batch.usable | True)",
        ("tests/test_evaluate.py::test_ssim_takes_the_range_of_the_measured_crop",),
        "the range of a crop counts invalid pixels",
    ),
    Mutant(
        "stages/common/intervals.py",
        "np.var(values, ddof=1)",
        "np.var(values, ddof=0)",
        (
            "tests/test_intervals.py::test_joined_variances_have_welch_s_freedom",
            "tests/test_intervals.py::test_the_variance_of_a_mean_of_runs_divides_by_one_less",
        ),
        "variances over training runs divide by n",
    ),
    Mutant(
        "stages/common/intervals.py",
        "sum() * (count - 1) / count",
        "sum() / count",
        ("tests/test_intervals.py::test_the_jackknife_of_a_plain_mean_is_the_textbook_interval",),
        "the jackknife forgets its factor n - 1",
    ),
    Mutant(
        "stages/common/intervals.py",
        "float(stats.t.ppf(0.5 + level / 2, freedom))",
        "float(stats.norm.ppf(0.5 + level / 2))",
        ("tests/test_intervals.py::test_student_of_one_degree_is_cauchy",),
        "intervals take the normal quantile for Student's",
    ),
    Mutant(
        "schemas/files/inputs.py",
        "        names.append((state.st_dev, state.st_ino))\n",
        "",
        ("tests/test_schemas.py::test_an_output_that_is_a_hard_link_to_an_input_is_refused",),
        "an output may be a hard link to an input",
    ),
    Mutant(
        "schemas/files/outputs.py",
        "    if mode and not overwrite:",
        "    if mode and overwrite:",
        ("tests/test_schemas.py::test_an_output_never_replaces_an_input_nor_an_existing_file",),
        "existing files are replaced without --overwrite",
    ),
    Mutant(
        "schemas/reading.py",
        "    if unit and unit not in allowed:",
        "    if False and unit not in allowed:",
        ("tests/test_schemas.py::test_wrong_unit_missing_variable_and_wrong_size_are_named",),
        "units are not looked at",
    ),
    Mutant(
        "schemas/checks.py",
        "np.abs(length - 1) > UNIT_TOLERANCE",
        "np.abs(length - 1) > 1e9",
        ("tests/test_schemas.py::test_directions_have_length_1",),
        "directions of any length are taken",
    ),
    Mutant(
        "schemas/reading.py",
        "result = (values * scale + offset).astype(np.float32)",
        "result = (values * scale).astype(np.float32)",
        ("tests/test_schemas.py::test_packed_numbers_are_scaled_and_moved",),
        "add_offset of packed numbers is ignored",
    ),
    Mutant(
        "stages/albedo/posterior.py",
        "scaled = weight * np.float32(1.0 / max(spread.own[k, level], 1e-12))",
        "scaled = weight * np.float32(1.0 / max(float(spread.own[:, level].mean()), 1e-12))",
        ("tests/test_albedo.py::test_noisy_images_weigh_less",),
        "all images weigh alike in the albedo, whatever their errors",
    ),
    Mutant(
        "stages/albedo/posterior.py",
        "                    confidence[k, r, c] *= weights[i]\n",
        "",
        ("tests/test_albedo.py::test_what_one_image_shows_alone_loses_its_weight",),
        "outliers keep their full weight in the albedo",
    ),
    Mutant(
        "stages/match/base.py",
        "crossCheck=True",
        "crossCheck=False",
        ("tests/test_match.py::test_mutual_nearest_keeps_only_reciprocal_pairs",),
        "matches need not be mutual",
    ),
)

MUTANTS = (*KNOWN, *PHYSICS, *STAGES)
