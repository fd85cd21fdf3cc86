// What tiles.c needs of OpenCL C 1.2. A work-group is one warp, so that votes and sums have barriers at which all meet.
#if !IS_FLOAT
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#pragma OPENCL EXTENSION cl_khr_int64_base_atomics : enable
#define BITS ulong
#define as_bits as_ulong
#define as_real as_double
#define ADD_BITS atom_add
#define SWAP_BITS atom_cmpxchg
#else
#define BITS uint
#define as_bits as_uint
#define as_real as_float
#define ADD_BITS atomic_add
#define SWAP_BITS atomic_cmpxchg
#endif
#define KERNEL(name) __kernel __attribute__((reqd_work_group_size(THREADS, 1, 1))) void name
#define ALIGNED __attribute__((aligned(16)))
#define INLINE static
#define GLOBAL __global
#define SHARED __local
#define IN_SHARED __local
#define SCRATCH __local int votes; __local real numbers_of_warp[THREADS * NUM_SUMS]
#define INDEX long
#define BLOCK ((int)get_group_id(0))
#define THREAD ((int)get_local_id(0))
#define BARRIER barrier(CLK_LOCAL_MEM_FENCE)
#define ANY_IN_BLOCK(flag) any_in_group(&votes, flag)
#define ANY_IN_WARP(flag) any_in_group(&votes, flag)
#define ADD_IN_WARP(row, numbers) add_in_group(numbers_of_warp, row, numbers)
#define READ_TEXEL(row, numbers) for (int c = 0; c < NUM_VALUES; c++) (numbers)[c] = (row)[c]
#define ADD_TEXEL(row, weight, numbers) add_texel(row, weight, numbers)
#define ATOMIC_ADD(place, number) add_atomically(place, number)
#define TOTALS_AGAIN
#define a2tg_inf_float() INFINITY
#define a2tg_nan_float() NAN
#define a2tg_inf_double() as_double(0x7ff0000000000000ul)
#define a2tg_nan_double() as_double(0x7ff8000000000000ul)

static int any_in_group(volatile __local int *votes, int flag) {
  BARRIER;
  if (get_local_id(0) == 0) *votes = 0;
  BARRIER;
  if (flag) atomic_or(votes, 1);
  BARRIER;
  return *votes;
}

static void add_in_group(__local real *numbers_of_warp, __local real *row, const real *numbers) {
  BARRIER;
  for (int k = 0; k < NUM_SUMS; k++) numbers_of_warp[get_local_id(0) * NUM_SUMS + k] = numbers[k];
  BARRIER;
  for (int k = get_local_id(0); k < NUM_SUMS; k += THREADS) {
    real sum = 0;
    for (int thread = 0; thread < THREADS; thread++) sum += numbers_of_warp[thread * NUM_SUMS + k];
    row[k] += sum;
  }
}

static void add_atomically(volatile __global real *place, real number) {
  volatile __global BITS *bits = (volatile __global BITS *)place;
  BITS found = ADD_BITS(bits, 0), expected;
  do {
    expected = found;
    found = SWAP_BITS(bits, expected, as_bits(as_real(expected) + number));
  } while (found != expected);
}

static void add_texel(__global real *row, real weight, const real *numbers) {
  for (int c = 0; c < NUM_VALUES; c++) add_atomically(row + c, weight * numbers[c]);
}
