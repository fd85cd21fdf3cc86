// Compositing of tiles, front to back: `forward`, and `backward` for the gradients. One thread a pixel.
//
// This is the dialect that CUDA C++ and OpenCL C share; cuda.h and opencl.h define what differs. In front of it stand
// the functions of one pixel (prepare, prepare_vjp, reach, corners, interpolate, blend, blend_vjp), printed from JAX.
//
// A block composites THREADS pixels of one tile. It copies BATCH splats of the tile's list at a time to shared memory,
// prepares each for the tile there, and lets every pixel take them in turn.

typedef struct {
  int tile, view;             // The tile, counted through all views, and its view.
  int first, last;            // Where its list begins and ends.
  int pixel, is_inside;       // Index within the tile, row by row; whether the pixel belongs to the image.
  real x, y, tile_x, tile_y;  // The pixel, counted from the tile's centre; the centre, in pixels of the image.
} Place;

// Aligned, so that several numbers are read at once; the planes, which all pixels read, come first.
typedef struct ALIGNED {
  real planes[NUM_PLANES];
  real limit;  // Squared distance within which a pixel is looked at.
  int id, region[3];
  real numbers[NUM_NUMBERS];
  real texel[NUM_VALUES + 1];  // The texel of a texture that has only one.
} Entry;

// Pixels of a warp form a block of 8×4 if such blocks fill the tile: a compact block sees fewer splats than a row does.
INLINE int pixel_of(int k) {
  if (TILE_SIZE % 8 != 0) return k;
  int block = k / 32, columns = TILE_SIZE / 8;
  return (block / columns * 4 + k % 32 / 8) * TILE_SIZE + block % columns * 8 + k % 8;
}

// size: columns of tiles, width and height of a view, and its tiles. A view has a start more than it has tiles.
INLINE Place place_of(GLOBAL const int *starts, GLOBAL const int *size) {
  Place at;
  int k = BLOCK % PARTS * THREADS + THREAD;
  at.tile = BLOCK / PARTS;
  at.view = at.tile / size[3];
  at.first = starts[at.tile + at.view];
  at.last = starts[at.tile + at.view + 1];
  int own = at.tile % size[3];
  at.pixel = pixel_of(k);
  at.x = (real)(at.pixel % TILE_SIZE) - (real)(TILE_SIZE - 1) / 2;
  at.y = (real)(at.pixel / TILE_SIZE) - (real)(TILE_SIZE - 1) / 2;
  at.tile_x = (real)(own % size[0] * TILE_SIZE) + (real)TILE_SIZE / 2;
  at.tile_y = (real)(own / size[0] * TILE_SIZE) + (real)TILE_SIZE / 2;
  at.is_inside = k < NUM_PIXELS && at.tile_x + at.x < size[1] && at.tile_y + at.y < size[2];
  return at;
}

INLINE void load(
  IN_SHARED Entry *entry, int id, Place at, GLOBAL const real *splats, GLOBAL const int *regions,
  GLOBAL const real *texels
) {
  GLOBAL const real *row = splats + (INDEX)id * (NUM_NUMBERS + 1);
  real numbers[NUM_NUMBERS], planes[NUM_PLANES];
  for (int k = 0; k < NUM_NUMBERS; k++) entry->numbers[k] = numbers[k] = row[k];
  prepare(numbers, at.tile_x, at.tile_y, planes);
  for (int k = 0; k < NUM_PLANES; k++) entry->planes[k] = planes[k];
  for (int k = 0; k < 3; k++) entry->region[k] = NUM_VALUES ? regions[(INDEX)id * 3 + k] : 0;
  entry->limit = row[NUM_NUMBERS] + (real)CUTOFF_SLACK;
  entry->id = id;
#if NUM_VALUES
  real texel[NUM_VALUES];
  if (entry->region[1] * entry->region[2] != 1) return;
  READ_TEXEL(texels + (INDEX)entry->region[0] * NUM_VALUES, texel);
  for (int c = 0; c < NUM_VALUES; c++) entry->texel[c] = texel[c];
#endif
}

// The splat of an entry as variables of a thread.
#define UNPACK(entry)                                                             \
  real numbers[NUM_NUMBERS], planes[NUM_PLANES];                                  \
  int region[3];                                                                  \
  for (int n = 0; n < NUM_NUMBERS; n++) numbers[n] = (entry).numbers[n];          \
  for (int n = 0; n < NUM_PLANES; n++) planes[n] = (entry).planes[n];             \
  for (int n = 0; n < 3; n++) region[n] = (entry).region[n]

#if NUM_VALUES
// What a pixel reads of the splat's texture: C values, and their derivatives by x and by y.
INLINE void look_up(
  IN_SHARED const Entry *entry, const int *region, const real *position, GLOBAL const real *texels, int *texel,
  real *weights, real *sample
) {
  real at_corners[4 * NUM_VALUES];
  int area = region[1] * region[2];
  if (area == 1) { // The same at all positions; most textures have one texel.
    for (int c = 0; c < NUM_VALUES; c++) sample[c] = entry->texel[c];
    for (int c = NUM_VALUES; c < 3 * NUM_VALUES; c++) sample[c] = 0;
    return;
  }
  corners(region, position, texel, weights);
  for (int c = 0; c < 4 * NUM_VALUES; c++) at_corners[c] = 0;
  for (int k = 0; k < 4 && area > 0; k++)
    READ_TEXEL(texels + (INDEX)texel[k] * NUM_VALUES, at_corners + k * NUM_VALUES);
  interpolate(region, weights, at_corners, sample);
}
#endif

KERNEL(forward)(
  GLOBAL const int *ids, GLOBAL const int *starts, GLOBAL const real *splats, GLOBAL const int *regions,
  GLOBAL const real *texels, GLOBAL const int *size, GLOBAL real *result
) {
  SHARED Entry batch[BATCH];
  SCRATCH;
  Place at = place_of(starts, size);
  real transmittance = 1, channels[NUM_CHANNELS];
  int is_live = at.is_inside;
  for (int c = 0; c < NUM_CHANNELS; c++) channels[c] = 0;
  for (int start = at.first; start < at.last; start += BATCH) {
    if (!ANY_IN_BLOCK(is_live)) break;
    int count = at.last - start < BATCH ? at.last - start : BATCH;
    for (int k = THREAD; k < count; k += THREADS) load(&batch[k], ids[start + k], at, splats, regions, texels);
    BARRIER;
    for (int k = 0; k < count && is_live; k++) {
      UNPACK(batch[k]);
      real rho, position[2], sample[3 * NUM_VALUES + 1];
      reach(planes, region, at.x, at.y, &rho, position);
      if (!(rho <= batch[k].limit)) continue;
#if NUM_VALUES
      int texel[4];
      real weights[12];
      look_up(&batch[k], region, position, texels, texel, weights, sample);
#endif
      blend(planes, numbers, sample, at.x, at.y, transmittance, is_live, channels, &transmittance, &is_live, channels);
    }
  }
  if (BLOCK % PARTS * THREADS + THREAD >= NUM_PIXELS) return;
  GLOBAL real *own = result + (INDEX)at.tile * (NUM_CHANNELS + 1) * NUM_PIXELS + at.pixel;
  for (int c = 0; c < NUM_CHANNELS; c++) own[c * NUM_PIXELS] = channels[c];
  own[NUM_CHANNELS * NUM_PIXELS] = transmittance;
}

// Adds the sums of a splat over a block's pixels to its rows of the gradients.
INLINE void flush(
  IN_SHARED const Entry *entry, IN_SHARED const real *shared_sums, Place at, GLOBAL real *d_splats, GLOBAL real *d_texels,
  GLOBAL real *d_probe
) {
  real sums[NUM_SUMS], numbers[NUM_NUMBERS], d_M[9];
  for (int k = 0; k < NUM_SUMS; k++) sums[k] = shared_sums[k];
  if (sums[COUNT] == 0) return;
  for (int k = 0; k < NUM_NUMBERS; k++) numbers[k] = entry->numbers[k];
  prepare_vjp(numbers, at.tile_x, at.tile_y, sums, d_M);
  GLOBAL real *row = d_splats + (INDEX)entry->id * (NUM_NUMBERS + 1);
  for (int k = 0; k < 9; k++) ATOMIC_ADD(row + k, d_M[k]);
  for (int k = 9; k < NUM_NUMBERS; k++) ATOMIC_ADD(row + k, sums[NUM_PLANES + k - 9]);
#if HAS_STATISTIC
  for (int k = 0; k < 4; k++) ATOMIC_ADD(d_probe + (INDEX)entry->id * 4 + k, sums[COUNT - 3 + k]);
#endif
#if NUM_VALUES
  if (entry->region[1] * entry->region[2] != 1) return;
  for (int c = 0; c < NUM_VALUES; c++)
    ATOMIC_ADD(d_texels + (INDEX)entry->region[0] * NUM_VALUES + c, sums[COUNT + 1 + c]);
#endif
}

// sums: cotangents of the planes, of the numbers behind M, the statistic, the count of pixels, and of a single texel.
KERNEL(backward)(
  GLOBAL const int *ids, GLOBAL const int *starts, GLOBAL const real *splats, GLOBAL const int *regions,
  GLOBAL const real *texels, GLOBAL const int *size, GLOBAL const real *g, GLOBAL const real *suffix_sums,
  GLOBAL const real *jacobians, GLOBAL real *d_splats, GLOBAL real *d_texels, GLOBAL real *d_probe TOTALS_AGAIN
) {
  SHARED Entry batch[BATCH];
  SHARED real batch_sums[BATCH * NUM_SUMS];
  SCRATCH;
  Place at = place_of(starts, size);
  real transmittance = 1, suffix_sum = 0, cotangents[NUM_CHANNELS], center[2], jacobian[9];
  int is_live = at.is_inside;
  int own = at.is_inside ? at.pixel : 0;
  center[0] = at.tile_x;
  center[1] = at.tile_y;
  for (int k = 0; k < 9; k++) jacobian[k] = jacobians[at.view * 9 + k];
  for (int c = 0; c < NUM_CHANNELS; c++) cotangents[c] = g[((INDEX)at.tile * NUM_CHANNELS + c) * NUM_PIXELS + own];
  suffix_sum = suffix_sums[(INDEX)at.tile * NUM_PIXELS + own];
  for (int start = at.first; start < at.last; start += BATCH) {
    if (!ANY_IN_BLOCK(is_live)) break;
    int count = at.last - start < BATCH ? at.last - start : BATCH;
    for (int k = THREAD; k < count; k += THREADS) load(&batch[k], ids[start + k], at, splats, regions, texels);
    for (int k = THREAD; k < BATCH * NUM_SUMS; k += THREADS) batch_sums[k] = 0;
    BARRIER;
    int is_warp_live = ANY_IN_WARP(is_live);
    for (int k = 0; k < count && is_warp_live; k++) {
      UNPACK(batch[k]);
      real rho, position[2], sample[3 * NUM_VALUES + 1], d_values[NUM_VALUES + 1], sums[NUM_SUMS];
      int is_reached = 0, contributes = 0;
      if (is_live) {
        reach(planes, region, at.x, at.y, &rho, position);
        is_reached = rho <= batch[k].limit;
      }
      if (!ANY_IN_WARP(is_reached)) continue;
      for (int n = 0; n < NUM_SUMS; n++) sums[n] = 0;
#if NUM_VALUES
      int texel[4];
      real weights[12];
      if (is_reached) look_up(&batch[k], region, position, texels, texel, weights, sample);
#endif
      if (is_reached)
        blend_vjp(planes, numbers, region, sample, at.x, at.y, transmittance, is_live, suffix_sum, cotangents, center,
                  jacobian, &transmittance, &is_live, &suffix_sum, &contributes, d_values, sums);
      if (!contributes) // What a pixel that shows nothing would add may not be finite.
        for (int n = 0; n < NUM_SUMS; n++) sums[n] = 0;
      sums[COUNT] = contributes;
#if NUM_VALUES
      int area = region[1] * region[2];
      for (int c = 0; c < NUM_VALUES; c++) sums[COUNT + 1 + c] = contributes && area == 1 ? d_values[c] : 0;
      if (contributes && area > 1)
        for (int corner = 0; corner < 4; corner++)
          ADD_TEXEL(d_texels + (INDEX)texel[corner] * NUM_VALUES, weights[corner], d_values);
#endif
      ADD_IN_WARP(batch_sums + k * NUM_SUMS, sums);
    }
    BARRIER;
    for (int k = THREAD; k < count; k += THREADS)
      flush(&batch[k], batch_sums + k * NUM_SUMS, at, d_splats, d_texels, d_probe);
  }
}
