"""A client of `lunargr serve`, and a lander that finds its way down with it.

    lunargr serve --dem scene/dem.tif --model hapke --port 5555
    python examples/serve_client.py 5555 30.77 20.19

The lander knows its attitude, and its place to some hundred metres. At each step it takes a picture, renders what it would see
where it believes to be, tracks corners between both (Lucas-Kanade), and corrects its place with the ground points that the
rendering knows: bearings meet in one point, by least squares. It then steers towards the target with thrusters that err.
"""

from __future__ import annotations

import argparse
import json
import math

import cv2
import numpy as np
import zmq

RADIUS = 1737400.0  # m


class Client:
    """`view` sends one request and gives its arrays by name."""

    def __init__(self, address: str, timeout_s: float = 120.0) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.REQ)
        self._socket.rcvtimeo = int(1000 * timeout_s)
        self._socket.connect(address)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_) -> None:
        self._context.destroy(linger=0)

    def view(self, camera: dict, sun: dict, arrays: list[str], seed: int = 0) -> dict[str, np.ndarray]:
        request = {"camera": camera, "sun": sun, "arrays": arrays, "seed": seed}
        self._socket.send(json.dumps(request).encode())
        header, *data = self._socket.recv_multipart()
        header = json.loads(header)
        if "error" in header:
            raise ValueError(header["error"])
        listed = zip(header["arrays"], data, strict=True)
        return {a["name"]: np.frombuffer(d, a["dtype"]).reshape(a["shape"]) for a, d in listed}


def body_fixed(lon: np.ndarray, lat: np.ndarray, radius: np.ndarray) -> np.ndarray:
    lon, lat = np.radians(lon), np.radians(lat)
    return (
        np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], -1)
        * np.asarray(radius)[..., None]
    )


class Lander:
    """Places are east, north, up of the target, m; the camera looks straight down with north up."""

    def __init__(
        self, client: Client, lon: float, lat: float, sun: dict, size: int = 256, fov_deg: float = 40.0
    ) -> None:
        self.client, self.sun, self.size = client, sun, size
        self.focal = size / 2 / math.tan(math.radians(fov_deg / 2))
        a, b = math.radians(lon), math.radians(lat)
        up = np.array([math.cos(b) * math.cos(a), math.cos(b) * math.sin(a), math.sin(b)])
        east = np.array([-math.sin(a), math.cos(a), 0.0])
        self.axes = np.stack([east, np.cross(up, east), up])  # rows: east, north, up
        self.origin = up * RADIUS

    def look(self, place: np.ndarray, arrays: list[str], seed: int = 0) -> dict[str, np.ndarray]:
        document = {
            "type": "pinhole",
            "focal_px": self.focal,
            "principal_point_px": [self.size / 2] * 2,
            "size_px": [self.size] * 2,
            "position_mcmf": (self.origin + place @ self.axes).tolist(),
            "rotation_camera_to_mcmf": (self.axes.T @ np.diag([1.0, -1.0, -1.0])).tolist(),
        }
        return self.client.view(document, self.sun, arrays, seed)

    def correct(self, picture: np.ndarray, believed: np.ndarray) -> tuple[np.ndarray, int]:
        """Where the picture was taken, and the number of corners that say so."""
        seen = self.look(believed, ["image", "depth"])
        expected, actual = to_grey(seen["image"]), to_grey(picture)
        corners = cv2.goodFeaturesToTrack(expected, 300, 0.01, 7)
        window = {"winSize": (21, 21), "maxLevel": 4}
        found, status, _ = cv2.calcOpticalFlowPyrLK(expected, actual, corners, None, **window)
        back, _, _ = cv2.calcOpticalFlowPyrLK(actual, expected, found, None, **window)
        good = (status.ravel() == 1) & (np.abs(back - corners).reshape(-1, 2).max(1) < 0.5)
        old, new = corners.reshape(-1, 2)[good], found.reshape(-1, 2)[good]
        column, row = np.rint(old).astype(int).T
        ground = believed + seen["depth"][row, column, None] * self.bearings(old)
        bearings = self.bearings(new)
        use = np.isfinite(ground).all(1)
        for _ in range(5):  # bearings that miss by more than the others do not count
            across = np.eye(3) - bearings[use, :, None] * bearings[use, None, :]
            place = np.linalg.solve(across.sum(0), (across @ ground[use, :, None]).sum(0)).ravel()
            miss = np.linalg.norm(np.cross(ground - place, bearings), axis=1) / np.linalg.norm(ground - place, axis=1)
            use = miss < 3 * np.median(miss[use]) + 1e-4
        return place, int(use.sum())

    def bearings(self, pixels: np.ndarray) -> np.ndarray:
        """(n, 3) east, north, up of pixels (x, y), whose first centre is 0, 0."""
        x, y = (pixels + 0.5 - self.size / 2).T / self.focal
        rays = np.stack([x, -y, -np.ones_like(x)], -1)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def to_grey(image: np.ndarray) -> np.ndarray:
    image = np.nan_to_num(image.astype(np.float32))
    return np.clip(255 * image / max(np.percentile(image, 99.5), 1e-6), 0, 255).astype(np.uint8)


def descend(
    lander: Lander, start: np.ndarray, believed: np.ndarray, target: np.ndarray, steps: int, taken: str, seed: int = 0
) -> list[float]:
    """Fly to the target; the errors of the believed place, m, before the first picture and after each."""
    rng = np.random.default_rng(seed)
    true, believed, errors = start.copy(), believed.copy(), [float(np.linalg.norm(believed - start))]
    print(f"{'altitude m':>10} {'before m':>9} {'after m':>8} {'corners':>8}")
    for step in range(steps):
        before = float(np.linalg.norm(believed - true))
        believed, corners = lander.correct(lander.look(true, [taken], seed=step)[taken], believed)
        errors.append(float(np.linalg.norm(believed - true)))
        print(f"{true[2]:10.1f} {before:9.2f} {errors[-1]:8.2f} {corners:8d}")
        wanted = (target - believed) / (steps - step)
        true += wanted * (1 + 0.05 * rng.normal(size=3)) if step < steps - 1 else 0.0
        believed += wanted if step < steps - 1 else 0.0
    return errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("port", type=int)
    parser.add_argument("longitude", type=float, help="of the target, deg")
    parser.add_argument("latitude", type=float)
    parser.add_argument("--ground", type=float, default=-2600.0, help="m above the sphere")
    parser.add_argument(
        "--height", type=float, nargs=2, default=(2500.0, 500.0), help="above ground, first and last, m"
    )
    parser.add_argument("--sun", type=float, nargs=2, default=(90.0, 25.0), help="azimuth and elevation, deg")
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--array", default="image", help="the picture that is taken: image, or dn of a sensor")
    options = parser.parse_args()
    sun = {"sun_azimuth_deg": options.sun[0], "sun_elevation_deg": options.sun[1]}
    high, low = options.height
    offset = 0.08 * high
    start = np.array([-2 * offset, offset, options.ground + high])
    believed = start + np.array([0.6, -0.8, 0.2]) * 0.05 * high
    target = np.array([0.0, 0.0, options.ground + low])
    with Client(f"tcp://127.0.0.1:{options.port}") as client:
        lander = Lander(client, options.longitude, options.latitude, sun)
        errors = descend(lander, start, believed, target, options.steps, options.array)
    print(f"position error: {errors[0]:.1f} m believed at first, {errors[-1]:.2f} m at {low:g} m above ground")


if __name__ == "__main__":
    main()
