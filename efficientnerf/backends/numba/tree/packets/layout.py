"""Where the numbers of a packet of rays lie in the scratch of a thread: LANES of each, one a ray.

Floats: where a ray's part in a cascade begins, its direction, the first sample and the one after the last; what it met, see below; the place where it lost half
of its light; what comes out of the voxels around a sample, (LANES, 4); the direction that harmonics are evaluated along, and their values, (K, LANES);
colours of some voxels along each ray, (CACHED, LANES, 4); two batches of a sample of each ray: the distance, the sum of the weights of the voxels that are
stored, and the weights, (4, LANES, 2), two of each row. Integers: the brick that a ray is in, and its sample's first row; whether the harmonics are evaluated;
which voxels have those colours, -1 for none; of each batch the first voxel of each row, (4, LANES).

State: transmittance; colour; distance at which the transmittance fell to one half; weight of samples near the camera without a colour yet, and that of the next
colour; counts of coarse cells visited, of samples tested, of samples interpolated and of colours looked up; depth and normal.
"""

LANES = 32  # rays of a packet; docs/experiments/renderer.md
ENTRY, ALONG, FIRST, LAST = 0, 3 * LANES, 6 * LANES, 7 * LANES  # x, y and z of all rays, and so on
TRANSMITTANCE, COLOUR, HALF_DISTANCE, PENDING_WEIGHT, GAIN = 8 * LANES, 9 * LANES, 12 * LANES, 13 * LANES, 14 * LANES
VISITED, TESTED, INTERPOLATED, LOOKUPS, DEPTH, NORMAL = range(15 * LANES, 21 * LANES, LANES)
PLACE = 23 * LANES
SAMPLE = 26 * LANES
SH_ALONG, BASIS = 30 * LANES, 33 * LANES
MOST_HARMONICS = 25
CACHED_BITS = 7
CACHED = 1 << CACHED_BITS  # colours of voxels near the camera that the rays of a packet share
COLOURS = BASIS + MOST_HARMONICS * LANES
DISTANCE, TOTAL, WEIGHT = range(0, 3 * LANES, LANES)
BATCH_FLOATS = 10 * LANES
BATCHES = COLOURS + 4 * LANES * CACHED
FLOATS = BATCHES + 2 * BATCH_FLOATS

OWNER, ROW, HAS_BASIS = 0, LANES, 2 * LANES
CACHE = 3 * LANES
BATCHES_OF_VOXELS = CACHE + CACHED
BATCH_VOXELS = 4 * LANES
INTS = BATCHES_OF_VOXELS + 2 * BATCH_VOXELS

# float64; then by cascade where they enter and leave it
ORIGIN, DIRECTION, COSINE, BEGIN, ENDS = 0, 3 * LANES, 6 * LANES, 7 * LANES, 8 * LANES

# The rays of a tile that are warped into normalised device coordinates, float64: origins and directions (n, 3), and what leads back: begin, ds_dt, dlogz_dt of
# `efficientnerf.geometry.ndc.NdcRays`, cosine to the view axis. Beside them their directions in the world, float32.
TILE_RAYS = 64
WARPED_ORIGIN, WARPED_DIRECTION = 0, 3 * TILE_RAYS
WARPED_BEGIN, WARPED_SPEED, WARPED_BEND, WARPED_COSINE = range(6 * TILE_RAYS, 10 * TILE_RAYS, TILE_RAYS)
WARPED = 10 * TILE_RAYS
