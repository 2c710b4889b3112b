"""Warp kernel of the fast simulator: eight sheets at a time, one per lane of a vector register."""

# Kernels are Python in syntax only: arrays and numbers follow Warp's own typing rules.
# mypy: disable-error-code="arg-type, assignment, call-overload, index, misc, no-untyped-def"
# mypy: disable-error-code="operator, type-var, valid-type, no-any-return, attr-defined"

import warp as wp

LANES = 8
"""Sheets that are simulated together."""

SLOW = 4
"""Steps between two evaluations of normals and of what the air does."""

Lanes = wp.types.vector(length=LANES, dtype=wp.float32)
"""One number of every sheet."""

PARAMETERS = (
    "step",  # s
    "gravity_x",
    "gravity_y",
    "gravity_z",  # m/s²
    "decay",  # 1/s, of every velocity
    "viscosity",  # 1/s, of relative velocity
    "time_stretch",
    "time_shear",
    "time_bend",  # s, Kelvin-Voigt
    "softening_edge",
    "softening_diagonal",  # relative per strain
    "linear_edge",
    "linear_shear",
    "square_edge",
    "square_shear",  # stiffening
    "in_plane",  # share of a bend's force within the surface, 0 or 1
    "drag",
    "drag_root",
    "drag_speed",
    "tangential",
    "plane",
    "ball",
    "normal_x",
    "normal_y",
    "normal_z",
    "offset",
    "centre_x",
    "centre_y",
    "centre_z",
    "radius",
    "friction",
    "vortex",
    "vortex_x",
    "vortex_y",
    "vortex_z",
    "axis_x",
    "axis_y",
    "axis_z",
    "inverse_vortex_radius",
    "yield_bend",
    "yield_rate",
    "compression_edge",
    "compression_diagonal",
    "length_u",
    "length_v",  # m
    "vertex_mass",  # kg
)
"""Rows of the table of numbers per sheet, in order; all 0 is a sheet without that feature."""

_INDEX = {name: index for index, name in enumerate(PARAMETERS)}

STEP = wp.constant(_INDEX["step"])
GRAVITY = wp.constant(_INDEX["gravity_x"])
DECAY = wp.constant(_INDEX["decay"])
VISCOSITY = wp.constant(_INDEX["viscosity"])
TIME_STRETCH = wp.constant(_INDEX["time_stretch"])
TIME_SHEAR = wp.constant(_INDEX["time_shear"])
TIME_BEND = wp.constant(_INDEX["time_bend"])
SOFTENING = wp.constant(_INDEX["softening_edge"])
LINEAR = wp.constant(_INDEX["linear_edge"])
SQUARE = wp.constant(_INDEX["square_edge"])
IN_PLANE = wp.constant(_INDEX["in_plane"])
DRAG = wp.constant(_INDEX["drag"])
TANGENTIAL = wp.constant(_INDEX["tangential"])
PLANE = wp.constant(_INDEX["plane"])
BALL = wp.constant(_INDEX["ball"])
NORMAL = wp.constant(_INDEX["normal_x"])
OFFSET = wp.constant(_INDEX["offset"])
CENTRE = wp.constant(_INDEX["centre_x"])
RADIUS = wp.constant(_INDEX["radius"])
FRICTION = wp.constant(_INDEX["friction"])
VORTEX = wp.constant(_INDEX["vortex"])
YIELD = wp.constant(_INDEX["yield_bend"])
COMPRESSION = wp.constant(_INDEX["compression_edge"])
LENGTH = wp.constant(_INDEX["length_u"])
MASS = wp.constant(_INDEX["vertex_mass"])
SLOW_STEPS = wp.constant(SLOW)


@wp.struct
class Vector:
    """One vector of every sheet."""

    x: Lanes
    y: Lanes
    z: Lanes


@wp.func
def load(a: wp.array(dtype=Lanes), i: wp.int32):
    """Vector at a vertex."""
    r = Vector()
    r.x = a[3 * i]
    r.y = a[3 * i + 1]
    r.z = a[3 * i + 2]
    return r


@wp.func
def accumulate(a: wp.array(dtype=Lanes), i: wp.int32, factor: wp.float32, b: Vector):
    """Add a multiple of a vector at a vertex."""
    a[3 * i] = a[3 * i] + factor * b.x
    a[3 * i + 1] = a[3 * i + 1] + factor * b.y
    a[3 * i + 2] = a[3 * i + 2] + factor * b.z


@wp.func
def difference(a: Vector, b: Vector):
    """Difference a - b."""
    r = Vector()
    r.x = a.x - b.x
    r.y = a.y - b.y
    r.z = a.z - b.z
    return r


@wp.func
def total(a: Vector, b: Vector):
    """Sum a + b."""
    r = Vector()
    r.x = a.x + b.x
    r.y = a.y + b.y
    r.z = a.z + b.z
    return r


@wp.func
def times(f: Lanes, a: Vector):
    """Product with a number of every sheet."""
    r = Vector()
    r.x = wp.cw_mul(f, a.x)
    r.y = wp.cw_mul(f, a.y)
    r.z = wp.cw_mul(f, a.z)
    return r


@wp.func
def inner(a: Vector, b: Vector):
    """Inner product."""
    return wp.cw_mul(a.x, b.x) + wp.cw_mul(a.y, b.y) + wp.cw_mul(a.z, b.z)


@wp.func
def outer(a: Vector, b: Vector):
    """Vector product."""
    r = Vector()
    r.x = wp.cw_mul(a.y, b.z) - wp.cw_mul(a.z, b.y)
    r.y = wp.cw_mul(a.z, b.x) - wp.cw_mul(a.x, b.z)
    r.z = wp.cw_mul(a.x, b.y) - wp.cw_mul(a.y, b.x)
    return r


@wp.func
def root(a: Lanes):
    """Square root."""
    r = Lanes()
    for k in range(LANES):
        r[k] = wp.sqrt(wp.max(a[k], wp.float32(0.0)))
    return r


@wp.func
def one():
    """1 for every sheet."""
    return Lanes(wp.float32(1.0))


@wp.func
def zero():
    """0 for every sheet."""
    return Lanes(wp.float32(0.0))


@wp.func
def stiffened(strain: Lanes, softening: Lanes, linear: Lanes, square: Lanes):
    """Stiffness at a strain over that at none; growth counts positive strain where the caller says so."""
    growth = wp.cw_mul(linear, strain)
    factor = one() + growth + wp.cw_mul(square, wp.cw_mul(strain, strain)) + wp.cw_mul(softening, strain)
    return wp.min(wp.max(factor, Lanes(wp.float32(0.2))), Lanes(wp.float32(10.0)))


@wp.func
def find_normals(
    x: wp.array(dtype=Lanes),
    cells: wp.array(dtype=wp.int32, ndim=2),
    areas: wp.array(dtype=wp.float32),
    inverse_area: Lanes,
    normals: wp.array(dtype=Lanes),
):
    """Normals (N) times the vertex's present over its rest area."""
    for i in range(normals.shape[0]):
        normals[i] = zero()
    for c in range(cells.shape[0]):
        d = difference(load(x, cells[c, 3]), load(x, cells[c, 0]))
        e = difference(load(x, cells[c, 2]), load(x, cells[c, 1]))
        n = outer(e, d)
        for k in range(4):
            accumulate(normals, cells[c, k], wp.float32(0.125), n)
    for i in range(areas.shape[0]):
        scale = inverse_area / areas[i]
        for k in range(3):
            normals[3 * i + k] = wp.cw_mul(scale, normals[3 * i + k])


@wp.func
def find_air(
    x: wp.array(dtype=Lanes),
    v: wp.array(dtype=Lanes),
    normals: wp.array(dtype=Lanes),
    p: wp.array(dtype=Lanes),
    series: wp.array(dtype=Lanes, ndim=2),
    row: wp.int32,
    has_vortex: wp.int32,
    air: wp.array(dtype=Lanes),
):
    """What air does per mass: wind, pressure, drag, a vortex."""
    wind = Vector()
    wind.x = series[row, 3]
    wind.y = series[row, 4]
    wind.z = series[row, 5]
    for i in range(normals.shape[0] / 3):
        n = load(normals, i)
        u = load(v, i)
        across = inner(u, n)
        square = inner(u, u)
        speed = root(square)
        rate = p[DRAG] + wp.cw_mul(p[DRAG + 1], root(speed)) + wp.cw_mul(p[DRAG + 2], speed)
        along = inner(wind, n) + series[row, 6]
        if has_vortex == 1:
            r = Vector()
            r.x = x[3 * i] - p[VORTEX + 1]
            r.y = x[3 * i + 1] - p[VORTEX + 2]
            r.z = x[3 * i + 2] - p[VORTEX + 3]
            axis = Vector()
            axis.x = p[VORTEX + 4]
            axis.y = p[VORTEX + 5]
            axis.z = p[VORTEX + 6]
            r = times(p[VORTEX + 7], difference(r, times(inner(r, axis), axis)))
            fall = one() + inner(r, r)
            turned = outer(axis, r)
            along = along + wp.cw_mul(p[VORTEX], wp.cw_div(inner(turned, n), wp.cw_mul(fall, fall)))
        share = wp.cw_mul(rate, p[TANGENTIAL])
        push = times(along - wp.cw_mul(rate - share, across), n)
        slow = times(share, u)
        air[3 * i] = push.x - slow.x + series[row, 0] + p[GRAVITY]
        air[3 * i + 1] = push.y - slow.y + series[row, 1] + p[GRAVITY + 1]
        air[3 * i + 2] = push.z - slow.z + series[row, 2] + p[GRAVITY + 2]


@wp.func
def add_springs(
    x: wp.array(dtype=Lanes),
    v: wp.array(dtype=Lanes),
    p: wp.array(dtype=Lanes),
    springs: wp.array(dtype=wp.int32, ndim=2),
    stiffness: wp.array(dtype=Lanes),
    series: wp.array(dtype=Lanes, ndim=2),
    row: wp.int32,
    f: wp.array(dtype=Lanes),
):
    """Edges along both directions and diagonals."""
    lu = wp.cw_mul(p[LENGTH], series[row, 7])
    lv = wp.cw_mul(p[LENGTH + 1], series[row, 8])
    uu = wp.cw_mul(lu, lu)
    vv = wp.cw_mul(lv, lv)
    drag = wp.cw_mul(p[VISCOSITY], p[MASS])
    iu = wp.cw_div(one(), uu)
    iv = wp.cw_div(one(), vv)
    id = wp.cw_div(one(), uu + vv)
    for s in range(springs.shape[0]):
        kind = springs[s, 2]
        a = springs[s, 0]
        b = springs[s, 1]
        e = difference(load(x, b), load(x, a))
        w = difference(load(v, b), load(v, a))
        inverse = id
        shear = wp.int32(1)
        if kind == 0:
            inverse = iu
            shear = wp.int32(0)
        elif kind == 1:
            inverse = iv
            shear = wp.int32(0)
        strain = wp.float32(0.5) * (wp.cw_mul(inner(e, e), inverse) - one())
        rate = wp.cw_mul(inner(e, w), inverse)
        pulled = wp.max(strain, zero())
        felt = pulled + wp.cw_mul(p[COMPRESSION + shear], strain - pulled)
        grown = pulled
        if shear == 1:
            grown = wp.max(strain, -strain)
        factor = stiffened(grown, p[SOFTENING + shear], p[LINEAR + shear], p[SQUARE + shear])
        amount = wp.cw_mul(stiffness[s], wp.cw_mul(felt, factor) + wp.cw_mul(p[TIME_STRETCH + shear], rate))
        force = total(times(amount, e), times(drag, w))
        accumulate(f, a, wp.float32(1.0), force)
        accumulate(f, b, wp.float32(-1.0), force)


@wp.func
def add_cells(
    x: wp.array(dtype=Lanes),
    v: wp.array(dtype=Lanes),
    p: wp.array(dtype=Lanes),
    cells: wp.array(dtype=wp.int32, ndim=2),
    stiffness: wp.array(dtype=Lanes),
    f: wp.array(dtype=Lanes),
):
    """Shear of every cell as an angle, which diagonals alone have no say in."""
    inverse = wp.cw_div(one(), wp.cw_mul(p[LENGTH], p[LENGTH + 1]))
    for c in range(cells.shape[0]):
        i = cells[c, 0]
        j = cells[c, 1]
        k = cells[c, 2]
        m = cells[c, 3]
        d = difference(load(x, m), load(x, i))
        e = difference(load(x, k), load(x, j))
        # Mean edges of the cell: b = ½ (d + e) along axis 0, a = ½ (d - e) along axis 1.
        b = times(Lanes(wp.float32(0.5)), total(d, e))
        a = times(Lanes(wp.float32(0.5)), difference(d, e))
        dv = difference(load(v, m), load(v, i))
        ev = difference(load(v, k), load(v, j))
        bv = times(Lanes(wp.float32(0.5)), total(dv, ev))
        av = times(Lanes(wp.float32(0.5)), difference(dv, ev))
        angle = wp.cw_mul(inner(a, b), inverse)
        rate = wp.cw_mul(inner(av, b) + inner(a, bv), inverse)
        grown = wp.max(angle, -angle)
        factor = stiffened(grown, zero(), p[LINEAR + 1], p[SQUARE + 1])
        amount = wp.cw_mul(stiffness[c], wp.cw_mul(angle, factor) + wp.cw_mul(p[TIME_SHEAR], rate))
        fa = times(amount, b)
        fb = times(amount, a)
        plus = total(fa, fb)
        minus = difference(fb, fa)
        accumulate(f, m, wp.float32(-0.5), plus)
        accumulate(f, i, wp.float32(0.5), plus)
        accumulate(f, k, wp.float32(-0.5), minus)
        accumulate(f, j, wp.float32(0.5), minus)


@wp.func
def add_bends(
    x: wp.array(dtype=Lanes),
    v: wp.array(dtype=Lanes),
    normals: wp.array(dtype=Lanes),
    p: wp.array(dtype=Lanes),
    straights: wp.array(dtype=wp.int32, ndim=2),
    stiffness: wp.array(dtype=Lanes),
    rest: wp.array(dtype=Lanes),
    yielding: wp.int32,
    f: wp.array(dtype=Lanes),
):
    """Bending of every three vertices in a row, with its rest bend, which a yielding cloth changes."""
    for s in range(straights.shape[0]):
        i = straights[s, 0]
        k = straights[s, 1]
        j = straights[s, 2]
        xk = load(x, k)
        vk = load(v, k)
        n = load(normals, k)
        c = difference(difference(load(x, i), xk), difference(xk, load(x, j)))
        w = difference(difference(load(v, i), vk), difference(vk, load(v, j)))
        bend = inner(c, n)
        if yielding == 1:
            away = bend - rest[s]
            beyond = wp.max(away - p[YIELD], zero()) - wp.max(-away - p[YIELD], zero())
            rest[s] = rest[s] + wp.cw_mul(p[YIELD + 1], beyond)
        d = total(c, times(p[TIME_BEND], w))
        across = inner(d, n)
        d = total(times(p[IN_PLANE], difference(d, times(across, n))), times(across - rest[s], n))
        force = times(stiffness[s], d)
        accumulate(f, i, wp.float32(-1.0), force)
        accumulate(f, k, wp.float32(2.0), force)
        accumulate(f, j, wp.float32(-1.0), force)


@wp.func
def pushed_out(xi: Vector, vi: Vector, p: wp.array(dtype=Lanes)):
    """Acceleration of a vertex by a plane and by a ball, with friction."""
    n = Vector()
    n.x = p[NORMAL]
    n.y = p[NORMAL + 1]
    n.z = p[NORMAL + 2]
    depth = wp.cw_mul(p[PLANE], wp.max(inner(xi, n) - p[OFFSET], zero()))
    centre = Vector()
    centre.x = p[CENTRE]
    centre.y = p[CENTRE + 1]
    centre.z = p[CENTRE + 2]
    r = difference(xi, centre)
    inverse = wp.cw_div(one(), p[RADIUS])
    sunk = wp.float32(0.5) * wp.cw_mul(inverse, wp.cw_mul(p[RADIUS], p[RADIUS]) - inner(r, r))
    sunk = wp.cw_mul(p[BALL], wp.max(sunk, zero()))
    # Of the two obstacles a sheet has one at most.
    away = difference(times(wp.cw_mul(p[BALL], inverse), r), times(p[PLANE], n))
    deep = depth + sunk
    touch = wp.min(wp.float32(1.0e4) * deep, one())
    speed = inner(vi, away)
    push = wp.float32(4.0e5) * deep - wp.float32(300.0) * wp.cw_mul(touch, wp.min(speed, zero()))
    slide = difference(vi, times(speed, away))
    grip = wp.cw_div(wp.cw_mul(p[FRICTION], push), root(inner(slide, slide)) + Lanes(wp.float32(0.02)))
    return difference(times(push, away), times(wp.min(grip, Lanes(wp.float32(1000.0))), slide))


@wp.kernel(enable_backward=False)
def simulate(
    x: wp.array(dtype=Lanes),
    v: wp.array(dtype=Lanes),
    f: wp.array(dtype=Lanes),
    normals: wp.array(dtype=Lanes),
    air: wp.array(dtype=Lanes),
    p: wp.array(dtype=Lanes),
    inverse_masses: wp.array(dtype=Lanes),
    areas: wp.array(dtype=wp.float32),
    springs: wp.array(dtype=wp.int32, ndim=2),
    spring_stiffness: wp.array(dtype=Lanes),
    cells: wp.array(dtype=wp.int32, ndim=2),
    cell_stiffness: wp.array(dtype=Lanes),
    straights: wp.array(dtype=wp.int32, ndim=2),
    bend_stiffness: wp.array(dtype=Lanes),
    rest_bends: wp.array(dtype=Lanes),
    pinned: wp.array(dtype=wp.int32),
    boundary: wp.array(dtype=Lanes, ndim=2),
    series: wp.array(dtype=Lanes, ndim=2),
    flags: wp.array(dtype=wp.int32),
    per_frame: wp.int32,
    frames: wp.array(dtype=Lanes, ndim=2),
):
    """Symplectic Euler steps of eight sheets; one thread does them all.

    ``x`` and ``v`` (3N,) are the state [m, m/s], vertex by vertex; ``f``, ``normals``, ``air`` are scratch.
    ``p`` (len(PARAMETERS),) and ``inverse_masses`` (N,) [1/kg] hold numbers of all sheets; ``areas`` (N,)
    counts cells. ``springs`` (n, 3) are ends and kind (0, 1 edges along axis 1 and 0, 2 diagonals) with
    stiffness [N/m]; ``cells`` (n, 4), row by row, with shear modulus [N/m]; ``straights`` (n, 3) with
    stiffness of the second difference [N/m] and rest bends [m]. ``boundary`` (T, 3k) are positions of the
    ``pinned`` at the end of every step [m]; ``series`` (ceil(T / SLOW), 9) uniform wind, wind on normals and
    pressure [m/s²], scales of rest lengths. ``flags`` (4,): whether any sheet has a vortex, yields, touches
    something, has angles. ``frames`` (F, 3N) is the result, one every ``per_frame`` steps; frame 0 is the
    caller's.
    """
    inverse_area = wp.cw_div(one(), wp.cw_mul(p[LENGTH], p[LENGTH + 1]))
    keep = one() - wp.cw_mul(p[DECAY], p[STEP])
    n = x.shape[0] / 3
    for step in range(boundary.shape[0]):
        row = step / SLOW_STEPS
        yielding = wp.int32(0)
        if step % SLOW_STEPS == 0:
            find_normals(x, cells, areas, inverse_area, normals)
            find_air(x, v, normals, p, series, row, flags[0], air)
            yielding = flags[1]
        for i in range(x.shape[0]):
            f[i] = zero()
        add_springs(x, v, p, springs, spring_stiffness, series, row, f)
        if flags[3] == 1:
            add_cells(x, v, p, cells, cell_stiffness, f)
        add_bends(x, v, normals, p, straights, bend_stiffness, rest_bends, yielding, f)
        for i in range(n):
            a = total(times(inverse_masses[i], load(f, i)), load(air, i))
            u = load(v, i)
            if flags[2] == 1:
                a = total(a, pushed_out(load(x, i), u, p))
            v[3 * i] = wp.cw_mul(keep, u.x + wp.cw_mul(p[STEP], a.x))
            v[3 * i + 1] = wp.cw_mul(keep, u.y + wp.cw_mul(p[STEP], a.y))
            v[3 * i + 2] = wp.cw_mul(keep, u.z + wp.cw_mul(p[STEP], a.z))
        for k in range(pinned.shape[0]):
            for c in range(3):
                j = 3 * pinned[k] + c
                v[j] = wp.cw_div(boundary[step, 3 * k + c] - x[j], p[STEP])
        for i in range(x.shape[0]):
            x[i] = x[i] + wp.cw_mul(p[STEP], v[i])
        if (step + 1) % per_frame == 0:
            frame = (step + 1) / per_frame
            for i in range(x.shape[0]):
                frames[frame, i] = x[i]
