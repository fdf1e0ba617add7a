"""From the signal on the detector to the numbers that are sent home."""

import numpy as np

from .faults import FAULTS, Place
from .hidden import Hidden
from .randomness import correlated_field, generator
from .world import World


def place_of(world: World, frame_number: int, first: tuple[int, int], shape: tuple[int, int]) -> Place:
    """Where on the detector a chip lies."""
    camera = world.frames[frame_number].camera
    scene = world.scenes[world.frames[frame_number].scene]
    reach = 0.5 * float(np.hypot(*scene.relief.shape)) / world.fine / camera.pixel_px
    return Place(first[0] + np.arange(shape[0]), first[1] + np.arange(shape[1]), camera.first, reach)


def column_response(hidden: Hidden, samples: np.ndarray) -> np.ndarray:
    """Smooth response over the detector's samples, of the rms asked for."""
    rng = generator(hidden.seed, "columns")
    width = 1400.0
    weights, phases = rng.standard_normal(10), np.pi * np.arange(4, 14)
    weights *= hidden.values["rms"] / np.sqrt(np.sum(weights**2) / 2)
    return 1 + np.cos(phases[None, :] * samples[:, None] / width) @ weights


def frame_response(world: World, frame_number: int, at: Place, hidden: Hidden) -> np.ndarray:
    """A response that varies over a frame as on unevenly developed film; its rms over the chip is as asked for."""
    rng = generator(hidden.seed, "frame field", frame_number)
    field = np.zeros((len(at.lines), len(at.samples)))
    for _ in range(4):
        wave = 1 / (world.size * rng.uniform(0.9, 3.0)) * np.exp(1j * rng.uniform(0, 2 * np.pi))
        angle = at.lines[:, None] * wave.imag + at.samples[None, :] * wave.real
        field += rng.standard_normal() * np.cos(2 * np.pi * angle + rng.uniform(0, 2 * np.pi))
    return 1 + hidden.values["rms"] * (field - field.mean()) / field.std()


def apply_sensor_effect(image: np.ndarray, world: World, frame_number: int, at: Place, hidden: Hidden) -> np.ndarray:
    """What an effect of the detector does to the signal, before noise."""
    v = hidden.values
    if hidden.name == "echo":
        return image + v["fraction"] * np.roll(image, int(v["lag_px"]), axis=int(v["axis"]))
    if hidden.name == "column_pattern":
        return image * column_response(hidden, at.samples)[None, :]
    if hidden.name == "frame_field":
        return image * frame_response(world, frame_number, at, hidden)
    if hidden.name == "dark_bias":
        return image + v["iof"]
    if hidden.name == "nonlinearity":
        return image + v["quadratic"] * image**2 + v["log"] * image * np.log(np.maximum(image, 1e-6))
    return image


def image_gains(world: World, hidden: Hidden) -> np.ndarray:
    """Gain of each image about 1; a hidden gain error takes the place of the ordinary one."""
    if hidden.name != "image_gain":
        return np.zeros(len(world.frames))
    draws = generator(hidden.seed, "gains").standard_normal(len(world.frames))
    used = draws[[frame for _, frame in world.pairs]]
    return hidden.values["rms"] * (draws - used.mean()) / used.std()


def read_out(
    signal: np.ndarray, world: World, pair: int, first: tuple[int, int], hidden: Hidden, noisy: bool
) -> np.ndarray:
    """The chip's image in I/F; without noise also without gain error, flat field residue and rounding."""
    frame_number = world.pairs[pair][1]
    frame, seed = world.frames[frame_number], world.seed
    at = place_of(world, frame_number, first, signal.shape)
    fault = FAULTS.get(hidden.name or "")
    rngs = generator(hidden.seed, "fault"), generator(hidden.seed, "fault", pair)
    size = hidden.values.get("size", 0.0)
    image = fault.act(signal, at, size, *rngs) if fault and fault.optical else signal
    image = apply_sensor_effect(image, world, frame_number, at, hidden)
    image = image * (1 + image_gains(world, hidden)[frame_number])
    if noisy:
        rng = generator(seed, "noise", pair)
        flat = generator(seed, "flat").standard_normal(8000)[at.samples]
        broad = frame.broad_rms * correlated_field(rng, image.shape, frame.broad_px)
        gain = 0.0 if hidden.name == "image_gain" else frame.gain_error
        image = image * (1 + gain) * (1 + world.flat_rms * flat)[None, :] * (1 + broad)
        level = float(signal.mean())
        variance = (level / frame.signal_to_noise) ** 2 * (0.8 * np.maximum(image, 0) / level + 0.2)
        image = image + np.sqrt(variance) * rng.standard_normal(image.shape)
    image = np.minimum(image, hidden.get("saturation", "iof", np.inf))
    if fault and not fault.optical:
        image = fault.act(image, at, size, *rngs)
    if noisy:
        step = float(signal.mean()) / 600
        image = np.round(image / step) * step
    return image
