// What tiles.c needs of CUDA C++.
// Registers for 24 warps on a processor: with 20, an H100 takes 1.1 times as long. Older ones lack the shared memory.
#define WARPS_AT_ONCE (IS_FLOAT && NUM_SUMS <= 32 && __CUDA_ARCH__ >= 900 ? 24 : 8)
#define KERNEL(name) extern "C" __global__ void __launch_bounds__(THREADS, WARPS_AT_ONCE * 32 / THREADS) name
#define ALIGNED __align__(16)
#define INLINE static __device__ __forceinline__
#define GLOBAL
#define SHARED __shared__
#define IN_SHARED
#define SCRATCH
#define INDEX long long
#define BLOCK ((int)blockIdx.x)
#define THREAD ((int)threadIdx.x)
#define BARRIER __syncthreads()
#define ANY_IN_BLOCK(flag) __syncthreads_or(flag)
#define ANY_IN_WARP(flag) __any_sync(~0u, flag)
#define ADD_IN_WARP(row, numbers) add_in_warp(row, numbers)
#define READ_TEXEL(row, numbers) read_texel(row, numbers)
#define ADD_TEXEL(row, weight, numbers) add_texel(row, weight, numbers)
#define ATOMIC_ADD(place, number) atomicAdd(place, number)
// XLA passes arrays that are added to among the operands, and once more among the results.
#define TOTALS_AGAIN , real *, real *, real *
#define a2tg_inf_float() __int_as_float(0x7f800000)
#define a2tg_nan_float() __int_as_float(0x7fc00000)
#define a2tg_inf_double() __longlong_as_double(0x7ff0000000000000ll)
#define a2tg_nan_double() __longlong_as_double(0x7ff8000000000000ll)

// One step of a sum over a warp: two lanes exchange halves of what they hold, and each adds what it got to its own half.
#define EXCHANGE(width)                                                                             \
  for (int k = 0; k < width; k++) {                                                                 \
    const real kept = lane & width ? part[k + width] : part[k];                                     \
    part[k] = kept + __shfl_xor_sync(~0u, lane & width ? part[k] : part[k + width], width);         \
  }

// Adds to a row in shared memory what the threads of a warp hold, summed: 31 exchanges leave the sum of number k in lane
// k, where one number alone needs five.
static __device__ __forceinline__ void add_in_warp(real *row, const real *numbers) {
  const int lane = threadIdx.x & 31;
#pragma unroll
  for (int first = 0; first < NUM_SUMS; first += 32) {
    real part[32];
#pragma unroll
    for (int k = 0; k < 32; k++) part[k] = first + k < NUM_SUMS ? numbers[first + k] : 0;
    EXCHANGE(16) EXCHANGE(8) EXCHANGE(4) EXCHANGE(2) EXCHANGE(1)
    if (first + lane < NUM_SUMS && part[0] != 0) atomicAdd(row + first + lane, part[0]);
  }
}

// Four floats of a texel in one instruction.
static __device__ __forceinline__ void read_texel(const real *row, real *numbers) {
#if NUM_VALUES == 4 && IS_FLOAT
  const float4 texel = __ldg((const float4 *)row);
  numbers[0] = texel.x, numbers[1] = texel.y, numbers[2] = texel.z, numbers[3] = texel.w;
#else
  for (int c = 0; c < NUM_VALUES; c++) numbers[c] = row[c];
#endif
}

// Adds weighted numbers to a texel; four floats in one instruction where the GPU has one.
static __device__ __forceinline__ void add_texel(real *row, real weight, const real *numbers) {
#if NUM_VALUES == 4 && IS_FLOAT && __CUDA_ARCH__ >= 900
  atomicAdd((float4 *)row, make_float4(weight * numbers[0], weight * numbers[1], weight * numbers[2], weight * numbers[3]));
#else
  for (int c = 0; c < NUM_VALUES; c++) atomicAdd(row + c, weight * numbers[c]);
#endif
}
