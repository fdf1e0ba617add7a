"""Light on the fine ground, traced with Mitsuba: direct light of a solar disc, bounces, a second source, a far ridge."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

SUN_RADIUS_DEG = 0.2666
NEAR_HORIZON = 0.12  # tangent of the elevation below which half of the rays for bounced light go


def _mitsuba():
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    return mi


def _mesh(mi, height: np.ndarray, cell: float, ridge: tuple[str, float, float] | None):
    n = height.shape[0]
    y, x = np.mgrid[0:n, 0:n]
    vertices = np.stack([x.ravel() * cell, -y.ravel() * cell, height.ravel()], 1).astype(np.float32)
    i = (y[:-1, :-1] * n + x[:-1, :-1]).ravel()
    faces = np.concatenate([np.stack([i, i + n, i + 1], 1), np.stack([i + 1, i + n, i + n + 1], 1)]).astype(np.uint32)
    if ridge is not None:
        side, distance, top = ridge
        wide, extent = 50 * n * cell, (n - 1) * cell
        a, b = {
            "north": ((-wide, distance), (wide, distance)),
            "south": ((-wide, -extent - distance), (wide, -extent - distance)),
            "east": ((extent + distance, -wide), (extent + distance, wide)),
            "west": ((-distance, -wide), (-distance, wide)),
        }[side]
        k = len(vertices)
        wall = [(*a, -1e4), (*b, -1e4), (*b, top), (*a, top)]
        vertices = np.concatenate([vertices, np.array(wall, np.float32)])
        faces = np.concatenate([faces, np.array([[k, k + 1, k + 2], [k, k + 2, k + 3]], np.uint32)])
    mesh = mi.Mesh("ground", len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.ravel()
    parameters["faces"] = faces.ravel()
    parameters.update()
    return mi.load_dict({"type": "scene", "ground": mesh})


def _disc(rng, direction: np.ndarray, radius_deg: float, count: int) -> np.ndarray:
    """Directions over a limb-darkened solar disc (u = 0.6), (count, 3), by rejection."""
    radius = np.tan(np.radians(radius_deg))
    up = np.array([0.0, 0.0, 1.0]) if abs(direction[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    a = np.cross(direction, up)
    a /= np.linalg.norm(a)
    b = np.cross(direction, a)
    r = np.sqrt(rng.uniform(size=4 * count))
    keep = rng.uniform(size=4 * count) < 1 - 0.6 * (1 - np.sqrt(1 - r * r))
    r = r[keep][:count]
    t = rng.uniform(0, 2 * np.pi, size=len(r))
    d = direction + radius * (r * np.cos(t))[:, None] * a + radius * (r * np.sin(t))[:, None] * b
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@dataclass
class Ground:
    """One site: fine heights, the traced scene and the hit points of the sampling grid."""

    height: np.ndarray  # (n, n) vertices
    cell: float
    first: int  # first fine row and column that is sampled
    count: int  # fine samples a side
    seed: int
    _scenes: dict = field(default_factory=dict)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        self.mi = _mitsuba()
        k = self.first + np.arange(self.count)
        y, x = np.meshgrid(k, k, indexing="ij")
        jitter = rng.uniform(0.1, 0.9, size=(2, self.count, self.count))
        px = ((x + jitter[0]) * self.cell).ravel().astype(np.float32)
        py = (-(y + jitter[1]) * self.cell).ravel().astype(np.float32)
        mi = self.mi
        origin = mi.Point3f(px, py, np.full(px.size, 1e4, np.float32))
        hit = self.scene(None).ray_intersect(mi.Ray3f(origin, mi.Vector3f(0, 0, -1)))
        self.normal = np.array(hit.n).T if np.array(hit.n).shape[0] == 3 else np.array(hit.n)
        self.normal = self.normal * np.sign(self.normal[:, 2:])
        place = np.array(hit.p)
        self.place = place.T if place.shape[0] == 3 else place

    def scene(self, ridge):
        if ridge not in self._scenes:
            self._scenes[ridge] = _mesh(self.mi, self.height, self.cell, ridge)
        return self._scenes[ridge]

    def seen(self, place: np.ndarray, normal: np.ndarray, direction: np.ndarray, ridge=None) -> np.ndarray:
        """1 where nothing lies between the points and the direction (one for all, or one each)."""
        mi = self.mi
        start = (place + 1e-3 * self.cell * normal).astype(np.float32)
        d = np.broadcast_to(direction, start.shape).astype(np.float32)
        ray = mi.Ray3f(mi.Point3f(*start.T.copy()), mi.Vector3f(*d.T.copy()))
        return 1.0 - np.array(self.scene(ridge).ray_test(ray)).astype(np.float32)

    def direct(self, sun: np.ndarray, seed: int, radius_deg: float = SUN_RADIUS_DEG, ridge=None, samples: int = 6):
        """(cos incidence, visible share of the disc), each (count, count) float32."""
        rng = np.random.default_rng(seed)
        discs = _disc(rng, sun, radius_deg, 64)
        share = np.zeros(len(self.place), np.float32)
        for _ in range(samples):
            d = discs[rng.integers(len(discs), size=len(self.place))]
            share += self.seen(self.place, self.normal, d, ridge) * ((self.normal * d).sum(1) > 0)
        shape = (self.count, self.count)
        return (self.normal @ sun).reshape(shape).astype(np.float32), (share / samples).reshape(shape)

    def bounced(self, sun: np.ndarray, seed: int, depth: int = 2, samples: int = 8) -> list[np.ndarray]:
        """Light that arrives after 1, 2, ... diffuse bounces on white ground, as I/F of a white facet.

        Terrain fills a per cent or so of a facet's sky, most of it close to the horizon: that is where the rays go, or the
        scatter of the few that hit would be several times the light.
        """
        mi, rng = self.mi, np.random.default_rng(seed)
        layers = [np.zeros(len(self.place), np.float32) for _ in range(depth)]
        turn = rng.uniform(size=len(self.place))
        for k in range(samples):
            place, normal = self.place, self.normal
            alive = np.ones(len(place), np.float32)
            for level in range(depth):
                around = (turn + k / samples if level == 0 else rng.uniform(size=len(place))) * 2 * np.pi
                direction, weight = _along_horizon(rng, normal, around)
                start = (place + 1e-3 * self.cell * normal).astype(np.float32)
                ray = mi.Ray3f(mi.Point3f(*start.T.copy()), mi.Vector3f(*direction.astype(np.float32).T.copy()))
                hit = self.scene(None).ray_intersect(ray)
                valid = np.array(hit.is_valid()).astype(np.float32)
                p, n = np.array(hit.p), np.array(hit.n)
                p, n = (p.T, n.T) if p.shape[0] == 3 else (p, n)
                alive = alive * valid * weight.astype(np.float32)
                n = np.where(valid[:, None] > 0, n, normal)
                n = n * np.sign(n[:, 2:])
                p = np.where(valid[:, None] > 0, p, place)
                lit = np.clip(n @ sun, 0, None) * self.seen(p, n, sun)
                layers[level] += alive * lit
                place, normal = p, n
        return [(layer / samples).reshape(self.count, self.count).astype(np.float32) for layer in layers]

    def facing(self, direction: np.ndarray) -> np.ndarray:
        """cos of the angle to a distant source, 0 where terrain hides it."""
        cosine = np.clip(self.normal @ direction, 0, None) * self.seen(self.place, self.normal, direction)
        return cosine.reshape(self.count, self.count).astype(np.float32)


def _along_horizon(rng, normal: np.ndarray, around: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions at azimuths ``around`` [rad], dense near the horizon (Cauchy in the tangent of elevation), with what each counts.

    The weight is cosine / pi over the density per solid angle; 0 where a facet cannot look.
    """
    rise = NEAR_HORIZON * np.tan(np.pi * (rng.uniform(size=len(normal)) - 0.5))
    level = 1 / np.sqrt(1 + rise**2)
    direction = np.stack([level * np.cos(around), level * np.sin(around), level * rise], 1)
    # density of the tangent, over azimuth and d(solid angle) / d(tangent) = level^3
    density = NEAR_HORIZON / (np.pi * (rise**2 + NEAR_HORIZON**2)) / (2 * np.pi * level**3)
    return direction, np.clip((direction * normal).sum(1), 0, None) / (np.pi * density)
