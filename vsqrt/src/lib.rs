//! Square root by the instruction for it, where the core has one.
//!
//! `core` has no square root, and `libm`'s is written in integers where the FPU of a Cortex-M4F has an instruction for it. Both are
//! rounded correctly, as IEEE 754 asks, so that every machine gives the same bits. The only `unsafe` code of the map is here.
#![no_std]
#![deny(missing_docs)]

/// Square root, correctly rounded; NaN of a negative value.
#[inline]
pub fn sqrt(value: f32) -> f32 {
    // The ABI passes floats in registers of the FPU, so there is one.
    #[cfg(all(target_arch = "arm", target_abi = "eabihf"))]
    {
        let mut bits = value.to_bits();
        // Through a core register: the compiler does not know of this target that there are registers of the FPU.
        // SAFETY: changes only the registers named, and the FPU's status, which is not said to be preserved.
        unsafe {
            core::arch::asm!(
                "vmov s0, {bits}",
                "vsqrt.f32 s0, s0",
                "vmov {bits}, s0",
                bits = inout(reg) bits,
                out("s0") _,
                options(pure, nomem, nostack),
            );
        }
        f32::from_bits(bits)
    }
    #[cfg(not(all(target_arch = "arm", target_abi = "eabihf")))]
    libm::sqrtf(value)
}

#[cfg(test)]
mod tests {
    use super::sqrt;

    #[test]
    fn it_is_the_root_at_the_corners() {
        assert_eq!(
            [0.0, 1.0, 2.0, 1e-45, f32::MAX].map(sqrt),
            [0.0, 1.0, core::f32::consts::SQRT_2, 3.743_392e-23, 1.844_674_3e19]
        );
        assert!(sqrt(-0.0).is_sign_negative() && sqrt(f32::INFINITY).is_infinite());
        assert!(sqrt(-1.0).is_nan() && sqrt(f32::NAN).is_nan());
    }
}
