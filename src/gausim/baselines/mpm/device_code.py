"""What Warp compiles for the CPU and CUDA: elasticity, and the kernels of one substep. Importing this imports Warp.

The kernels are those of stress, particles to grid, grid update and grid to particles: MLS-MPM (Hu et al. 2018) with
APIC (Jiang et al. 2015) and quadratic B-splines, whose inertia tensor is dx^2 / 4. Nodes lie at multiples of dx from
the origin of the domain; the arrays of nodes hold a window of them, which begins at node ``origin``. Every kernel reads
its inputs and writes or adds to its outputs only, so that Warp's adjoint is exact. The loops over nodes have a length
that is no constant, so that Warp does not unroll them into 27 copies.

The derivative of the Kirchhoff stress tau = J sigma is not that of a singular value decomposition, which is undefined
where stretches are equal, as at rest.
"""

import warp as wp

LEAST_NODE_MASS = wp.constant(1.0e-15)
POLAR_STEPS = wp.constant(20)  # at most; near rest two or three do
POLAR_TOLERANCE = wp.constant(1.0e-7)
LEAST_DETERMINANT = wp.constant(1.0e-4)  # below it Newton's iteration is not safe in float32


@wp.func
def identity() -> wp.mat33:
    """The unit matrix."""
    return wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@wp.func
def _polar_by_newton(F: wp.mat33) -> wp.mat33:
    """R <- (R + R^-T) / 2 until convergence (Higham 1986)."""
    R = F
    steps = int(POLAR_STEPS)
    for _ in range(steps):
        following = 0.5 * (R + wp.transpose(wp.inverse(R)))
        change = wp.ddot(following - R, following - R)
        R = following
        if change < POLAR_TOLERANCE * POLAR_TOLERANCE:
            break
    return R


@wp.func
def _polar_by_svd(F: wp.mat33) -> wp.mat33:
    """U V^T, for det F that is tiny or negative; a reflection is mended along the axis of the smallest stretch."""
    U, _s, V = wp.svd3(F)
    R = U * wp.transpose(V)
    if wp.determinant(R) < 0.0:
        mirror = wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0)
        R = U * mirror * wp.transpose(V)
    return R


@wp.func
def polar_rotation(F: wp.mat33) -> wp.mat33:
    """R of F = R S, with det R = 1 whatever the sign of det F."""
    R = identity()
    if wp.determinant(F) > LEAST_DETERMINANT:
        R = _polar_by_newton(F)
    else:
        R = _polar_by_svd(F)
    return R


@wp.func_grad(polar_rotation)
def _adjoint_polar_rotation(F: wp.mat33, adjoint: wp.mat33) -> None:
    """The derivative dR = R [w]x with (tr S I - S) w = axial(R^T dF - dF^T R), transposed."""
    R = polar_rotation(F)
    S = wp.transpose(R) * F
    P = wp.transpose(R) * adjoint
    p = wp.vec3(P[2, 1] - P[1, 2], P[0, 2] - P[2, 0], P[1, 0] - P[0, 1])
    K = wp.trace(S) * identity() - S
    if wp.abs(wp.determinant(K)) > 1.0e-10:
        wp.adjoint[F] += R * wp.skew(wp.inverse(K) * p)


@wp.func
def fixed_corotated(F: wp.mat33, mu: float, lam: float) -> wp.mat33:
    """Tau = 2 mu (F - R) F^T + lambda J (J - 1) I (Stomakhin et al. 2012)."""
    R = polar_rotation(F)
    J = wp.determinant(F)
    return 2.0 * mu * (F - R) * wp.transpose(F) + lam * J * (J - 1.0) * identity()


@wp.func
def spline_weights(f: wp.vec3) -> wp.mat33:
    """Row i: weights of the three axes at node i of three, f in [0.5, 1.5) cells from node 0."""
    one = wp.vec3(1.0, 1.0, 1.0)
    a, b, c = 1.5 * one - f, f - one, f - 0.5 * one
    w0, w1, w2 = 0.5 * wp.cw_mul(a, a), 0.75 * one - wp.cw_mul(b, b), 0.5 * wp.cw_mul(c, c)
    return wp.mat33(w0[0], w0[1], w0[2], w1[0], w1[1], w1[2], w2[0], w2[1], w2[2])


@wp.func
def inside(x: wp.vec3, nodes: wp.vec3i) -> bool:
    """True if the window has the 27 nodes of a particle, x in cells from its first node; false for NaN."""
    result = wp.isfinite(x[0]) and wp.isfinite(x[1]) and wp.isfinite(x[2])
    for axis in range(3):
        result = result and x[axis] >= 0.5 and x[axis] < float(nodes[axis]) - 1.5
    return result


@wp.kernel
def stress_kernel(
    deformation_gradients: wp.array[wp.mat33], young: wp.array[float], poisson: float, stress: wp.array[wp.mat33]
) -> None:
    """Kirchhoff stress per particle."""
    p = wp.tid()
    mu = young[p] / (2.0 * (1.0 + poisson))
    lam = young[p] * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    stress[p] = fixed_corotated(deformation_gradients[p], mu, lam)


@wp.kernel
def particles_to_grid(
    positions: wp.array[wp.vec3],
    velocities: wp.array[wp.vec3],
    affine: wp.array[wp.mat33],
    stress: wp.array[wp.mat33],
    mass: wp.array[float],
    volume: wp.array[float],
    inverse_dx: float,
    origin: wp.vec3,
    nodes: wp.vec3i,
    dt: float,
    grid: wp.array3d[wp.vec4],
) -> None:
    """Adds momentum (x, y, z) and mass (w) of the particles to the grid.

    m_i v_i = sum_p w_ip (m_p v_p + (m_p C_p - dt V_p 4 / dx^2 tau_p) (x_i - x_p))
    """
    p = wp.tid()
    x = positions[p] * inverse_dx - origin
    if not inside(x, nodes):
        return
    i, j, k = int(x[0] - 0.5), int(x[1] - 0.5), int(x[2] - 0.5)
    f = x - wp.vec3(float(i), float(j), float(k))
    w = spline_weights(f)
    A = mass[p] * affine[p] - (dt * volume[p] * 4.0 * inverse_dx * inverse_dx) * stress[p]
    momentum = mass[p] * velocities[p]
    three = 3
    for a in range(three):
        for b in range(three):
            for c in range(three):
                arm = (wp.vec3(float(a), float(b), float(c)) - f) / inverse_dx
                weight = w[a, 0] * w[b, 1] * w[c, 2]
                q = weight * (momentum + A * arm)
                wp.atomic_add(grid, i + a, j + b, k + c, wp.vec4(q[0], q[1], q[2], weight * mass[p]))


@wp.kernel
def grid_update(
    grid: wp.array3d[wp.vec4],
    pinned_nodes: wp.array3d[wp.uint8],
    pull: wp.vec3,
    normal: wp.vec3,
    level: float,
    friction: float,
    origin: wp.vec3,
    velocity: wp.array3d[wp.vec3],
) -> None:
    """Velocity of nodes: momentum over mass, plus ``pull``; 0 where nodes are pinned.

    Nodes on or behind the plane n . x = ``level`` [cells] lose their velocity into it, and along it as much as
    Coulomb's friction takes; without a plane n is 0.
    """
    i, j, k = wp.tid()
    node = grid[i, j, k]
    v = wp.vec3(0.0, 0.0, 0.0)
    if node[3] >= LEAST_NODE_MASS:
        v = wp.vec3(node[0], node[1], node[2]) / node[3] + pull
        place = origin + wp.vec3(float(i), float(j), float(k))
        into = wp.dot(v, normal)
        if into < 0.0 and wp.dot(place, normal) <= level:
            along = v - into * normal
            v = wp.max(0.0, 1.0 + friction * into / (wp.length(along) + 1.0e-9)) * along
    if pinned_nodes[i + int(origin[0]), j + int(origin[1]), k + int(origin[2])] != wp.uint8(0):
        v = wp.vec3(0.0, 0.0, 0.0)
    velocity[i, j, k] = v


@wp.kernel
def grid_to_particles(
    positions: wp.array[wp.vec3],
    deformation_gradients: wp.array[wp.mat33],
    velocity: wp.array3d[wp.vec3],
    held: wp.array[wp.uint8],
    inverse_dx: float,
    origin: wp.vec3,
    nodes: wp.vec3i,
    dt: float,
    new_positions: wp.array[wp.vec3],
    new_velocities: wp.array[wp.vec3],
    new_affine: wp.array[wp.mat33],
    new_gradients: wp.array[wp.mat33],
) -> None:
    """V = sum_i w_i v_i, C = 4 / dx^2 sum_i w_i v_i (x_i - x)^T, x += dt v, F = (I + dt C) F.

    Held particles keep their position.
    """
    p = wp.tid()
    v = wp.vec3(0.0, 0.0, 0.0)
    B = wp.mat33(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    x = positions[p] * inverse_dx - origin
    if inside(x, nodes):
        i, j, k = int(x[0] - 0.5), int(x[1] - 0.5), int(x[2] - 0.5)
        f = x - wp.vec3(float(i), float(j), float(k))
        w = spline_weights(f)
        three = 3
        for a in range(three):
            for b in range(three):
                for c in range(three):
                    u = (w[a, 0] * w[b, 1] * w[c, 2]) * velocity[i + a, j + b, k + c]
                    v += u
                    B += wp.outer(u, wp.vec3(float(a), float(b), float(c)) - f)
    C = (4.0 * inverse_dx) * B
    moved = positions[p] + dt * v
    if held[p] != wp.uint8(0):
        moved = positions[p]
    new_positions[p] = moved
    new_velocities[p] = v
    new_affine[p] = C
    new_gradients[p] = (identity() + dt * C) * deformation_gradients[p]
