"""Photographs on a mesh: how far each pixel is from what spoils it, what texels see in it, and one colour of what several photographs show (numba)."""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba

WEIGHT = 65535.0  # of a photograph that shows a texel best


@numba.njit(cache=True, error_model="numpy")
def mark_edges(near, jump, begin, end, out):
    """Sets `out` (H, W) to zero at jumps in depth between pixels of the rows `begin` to `end`, and between these and the row after them.

    near    (H, W) float32 inverse depth of the mesh, zero where it is not
    jump    by which share of itself the inverse depth of pixels side by side has to differ from what the pixels beyond them lead to expect
    """
    height, width = near.shape
    for row in range(begin, end):
        for column in range(width):
            here = near[row, column]
            for down, across in ((0, 1), (1, 0)):
                if row + down < height and column + across < width:
                    other = near[row + down, column + across]
                    left = near[row - down, column - across] if row >= down and column >= across else here
                    right = near[row + 2 * down, column + 2 * across] if row + 2 * down < height and column + 2 * across < width else other
                    if _jumps(left, here, other, right, jump):
                        out[row, column] = out[row + down, column + across] = 0.0


@numba.njit(cache=True, error_model="numpy")
def sweep_down(begin, end, out):
    """Half of a chamfer distance with steps of 1 and 1.4, from the zeros of `out` (H, W) float32: the rows `begin` to `end`, after all before them. The other
    half is that of the image turned by 180 degrees."""
    width = out.shape[1]
    for row in range(begin, end):
        for column in range(width):
            found = out[row, column]
            if column > 0:
                found = min(found, out[row, column - 1] + np.float32(1.0))
            if row > 0:
                found = min(found, out[row - 1, column] + np.float32(1.0))
                if column > 0:
                    found = min(found, out[row - 1, column - 1] + np.float32(1.4))
                if column + 1 < width:
                    found = min(found, out[row - 1, column + 1] + np.float32(1.4))
            out[row, column] = found


@numba.njit(cache=True, inline="always", error_model="numpy")
def _jumps(left, here, other, right, jump):
    """Whether the surface breaks between two pixels: on a plane inverse depths change evenly along a row."""
    if (here > 0.0) != (other > 0.0):
        return True
    step = abs(other - here)
    even = max(abs(here - left) if left > 0.0 else 0.0, abs(right - other) if right > 0.0 else 0.0)
    return step > jump * max(here, other) and step > 3.0 * even


@numba.njit(cache=True, inline="always", error_model="numpy")
def _catmull_rom(t):
    """Weights of four pixels in a row for a place between the middle two, `t` float32 from the second on: linear interpolation would blur."""
    half, one = np.float32(0.5), np.float32(1.0)
    squared, cubed = t * t, t * t * t
    first, last = half * (np.float32(2.0) * squared - t - cubed), half * (cubed - squared)
    second = one + half * (np.float32(3.0) * cubed - np.float32(5.0) * squared)
    return first, second, one - first - second - last, last


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def observe(
    begin_face, end_face, texel_begin, share, faces, pixels, depth, facing, near, clear, photo, gain, reach, slack, beside, density, sharpness, seen, weights,
):  # fmt: skip
    """Lets texels of faces `begin_face` to `end_face` see a photograph; of what a texel has seen the K best graded are kept.

    texel_begin  (F + 1,) int64 first texel of each face
    share        (T, 3) float32 barycentric coordinates
    faces        (F, 3) int64
    pixels       (V, 2) float64 of the vertices; nan: not in view
    depth        (V,) float64
    facing       (V,) float32 cosine of the vertex's normal to the direction of the camera
    near         (H, W) float32 inverse depth of the mesh
    clear        (H, W) float32 distance from edges, pixels
    photo        (H, W, 3) uint8
    gain         (3,) float32 factors of its colours
    reach        pixels from an edge at which it counts no more
    slack        share of its depth that a texel may lie behind what is seen
    beside       the same for each unit of the slope of its surface
    density      (F,) float32 pixels for each texel, of the photograph that has most: its square root
    sharpness    0 to 1, that its grades are multiplied by
    seen         (T, K, 3) uint8 colours
    weights      (T, K) uint16 WEIGHT times the square roots of their grades, descending; zero: none
    """
    height, width = near.shape
    kept = weights.shape[1]
    for face in numba.prange(begin_face, end_face):
        p, q, r = faces[face, 0], faces[face, 1], faces[face, 2]
        if not (depth[p] > 0.0 and depth[q] > 0.0 and depth[r] > 0.0 and max(facing[p], facing[q], facing[r]) > 0.05):
            continue
        if not (np.isfinite(pixels[p, 0]) and np.isfinite(pixels[q, 0]) and np.isfinite(pixels[r, 0])):
            continue
        left, right = min(pixels[p, 0], pixels[q, 0], pixels[r, 0]), max(pixels[p, 0], pixels[q, 0], pixels[r, 0])
        low, high = min(pixels[p, 1], pixels[q, 1], pixels[r, 1]), max(pixels[p, 1], pixels[q, 1], pixels[r, 1])
        if right < 1.0 or high < 1.0 or left > width - 1.0 or low > height - 1.0:
            continue
        area = abs((pixels[q, 0] - pixels[p, 0]) * (pixels[r, 1] - pixels[p, 1]) - (pixels[r, 0] - pixels[p, 0]) * (pixels[q, 1] - pixels[p, 1]))
        size = min(np.float32(np.sqrt(area)) / max(density[face], np.float32(1e-12)), np.float32(1.0))
        for texel in range(texel_begin[face], texel_begin[face + 1]):
            a, b, c = share[texel, 0] * depth[p], share[texel, 1] * depth[q], share[texel, 2] * depth[r]
            deep = a + b + c
            x, y = (a * pixels[p, 0] + b * pixels[q, 0] + c * pixels[r, 0]) / deep, (a * pixels[p, 1] + b * pixels[q, 1] + c * pixels[r, 1]) / deep
            if not (x >= 2.0 and y >= 2.0 and x < width - 2.0 and y < height - 2.0):
                continue
            column, row = int(x), int(y)
            cosine = share[texel, 0] * facing[p] + share[texel, 1] * facing[q] + share[texel, 2] * facing[r]
            free = clear[row, column]
            if not (cosine > 0.05 and free > 0.5):
                continue
            # A pixel's depth is that of its centre: a texel beside it may lie deeper by as much as the surface slopes. More would see through thin parts.
            slope = np.sqrt(max(np.float32(1.0) - cosine * cosine, np.float32(0.0))) / max(cosine, np.float32(0.2))
            if deep * near[row, column] > 1.0 + slack + beside * slope:
                continue
            edge = min(free / reach, np.float32(1.0))
            weight = np.uint16(np.float32(WEIGHT) * edge * size * np.sqrt(sharpness * cosine))
            if weight <= weights[texel, kept - 1]:
                continue
            u, v = x - 0.5, y - 0.5
            i, j = int(u), int(v)
            s, t = np.float32(u - i), np.float32(v - j)
            place = kept - 1
            while place > 0 and weights[texel, place - 1] < weight:
                weights[texel, place] = weights[texel, place - 1]
                for channel in range(3):
                    seen[texel, place, channel] = seen[texel, place - 1, channel]
                place -= 1
            weights[texel, place] = weight
            columns, rows = _catmull_rom(s), _catmull_rom(t)
            for channel in range(3):
                value = np.float32(0.0)
                for row in range(4):
                    along = np.float32(0.0)
                    for column in range(4):
                        along += columns[column] * np.float32(photo[j - 1 + row, i - 1 + column, channel])
                    value += rows[row] * along
                seen[texel, place, channel] = np.uint8(min(max(value * gain[channel] + np.float32(0.5), np.float32(0.0)), np.float32(255.0)))


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def blend(begin, end, seen, weights, scale, prior, vote, trust, out, known):
    """One colour for each of the texels `begin` to `end` from what they have seen.

    seen, weights  as for `observe`
    scale   difference of colours, 0-255, from which one that disagrees counts less
    prior   (T, 3) uint8 colour that is expected, and counts where little was seen
    vote    what it counts among the colours seen, of which the best counts one, where these disagree
    trust   its grade: the square of its weight
    out     (T, 3) uint8
    known   (T,) float32 share of the colour that is from photographs

    Starts at that colour, of those seen, which is nearest to all the others and to what is expected (by weighted absolute differences), then weights each by
    its difference from the mean (Geman-McClure), which is computed anew.
    """
    for texel in numba.prange(begin, end):
        count = 0
        while count < weights.shape[1] and weights[texel, count] > 0:
            count += 1
        if count == 0:
            known[texel] = 0.0
            for channel in range(3):
                out[texel, channel] = prior[texel, channel]
            continue
        best, least = 0, np.inf
        strongest = np.float64(weights[texel, 0])
        if count > 1:
            for one in range(count):
                total = 0.0
                for other in range(count):
                    apart = 0.0
                    for channel in range(3):
                        apart += abs(np.float64(seen[texel, one, channel]) - np.float64(seen[texel, other, channel]))
                    total += weights[texel, other] / strongest * apart
                for channel in range(3):
                    total += vote * abs(np.float64(seen[texel, one, channel]) - np.float64(prior[texel, channel]))
                if total < least:
                    best, least = one, total
        red, green, blue = np.float64(seen[texel, best, 0]), np.float64(seen[texel, best, 1]), np.float64(seen[texel, best, 2])
        for _ in range(3):
            total, reds, greens, blues = 0.0, 0.0, 0.0, 0.0
            for one in range(count):
                r, g, b = np.float64(seen[texel, one, 0]), np.float64(seen[texel, one, 1]), np.float64(seen[texel, one, 2])
                apart = ((r - red) ** 2 + (g - green) ** 2 + (b - blue) ** 2) / (scale * scale)
                weight = weights[texel, one] / strongest / ((1.0 + apart) * (1.0 + apart))
                total += weight
                reds, greens, blues = reds + weight * r, greens + weight * g, blues + weight * b
            red, green, blue = np.float64(reds / total), np.float64(greens / total), np.float64(blues / total)
        grade = (strongest / WEIGHT) ** 2
        share = grade / (grade + trust)
        known[texel] = share
        out[texel, 0] = np.uint8(min(max(share * red + (1.0 - share) * prior[texel, 0] + 0.5, 0.0), 255.0))
        out[texel, 1] = np.uint8(min(max(share * green + (1.0 - share) * prior[texel, 1] + 0.5, 0.0), 255.0))
        out[texel, 2] = np.uint8(min(max(share * blue + (1.0 - share) * prior[texel, 2] + 0.5, 0.0), 255.0))
