"""SIMD vectors for numba kernels.

numba has no vector type, and LLVM seldom vectorises loops that gather, branch or march. Here a `Vector` is a numba type of its own: `count` numbers of one
element type, an LLVM vector. LLVM maps it to the registers of the processor; a vector wider than a register becomes several. So a kernel is written once for
sixteen or thirty-two rays, and reads as it would for one:

    x, y = load(p, 0, 16), load(p, 16, 16)          # p: `pointer(array)` of float32; 16 lanes from p[0] and from p[16] on
    store(out, 0, select(x < y, fma(x, y, 1), sqrt(x)))

    types      Vector, and its operators: + - * / (float32, float64), + - * & | << >> (int32), & | ~ (booleans), comparisons, which give booleans
    maths      select, minimum, fma, floor, exp2_neg, sigmoid, conversions, sums over the lanes, bits of masks
    memory     pointers, loads and stores, gathers, groups of numbers a lane, prefetches, atomic additions
    halves     half floats as uint16
    corners    eight groups of numbers with a weight each: interpolation, and its reverse
    products   products of small matrices in tiles of registers
    emit       LLVM instructions that the others are made of

The number of lanes is an argument, and has to be a constant where the kernel is compiled. An operand may be a scalar: it stands in all lanes. Elements are
float32, float64, int32 and booleans.

Pointers, because passing an array to a function, or taking it out of a tuple, costs a reference count up and down. They check no bounds, and the caller
keeps the array alive.

No kernel lets the compiler reorder sums or fuse products into them (`fastmath`): a process that compiles a kernel and one that loads it from the cache use
copies that were optimised in different surroundings, and would differ in the last bit. What is to be fused says so, by `fma`.
"""
