//! Loops over points with the widest registers that the processor has.
//!
//! The build is for every x86-64, whose registers hold four numbers; most processors have AVX2, whose registers hold
//! eight. A [`WideLoop`] is compiled for both, and the processor at hand chooses. Each number is computed by the same
//! operations in the same order, so that both give the same bytes.

use pulp::{Arch, Simd, WithSimd};

/// A loop that is compiled for several processors. [`Self::run`] and all that it calls must be `#[inline(always)]`,
/// else they are compiled for the least of them.
pub(crate) trait WideLoop {
    /// Runs the loop.
    fn run(self);
}

/// Runs a loop on the best registers of this processor.
pub(crate) fn run_wide(work: impl WideLoop) {
    struct Wide<L>(L);

    impl<L: WideLoop> WithSimd for Wide<L> {
        type Output = ();

        #[inline(always)]
        fn with_simd<S: Simd>(self, _: S) {
            self.0.run();
        }
    }

    Arch::new().dispatch(Wide(work));
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Sums with a root and a choice, as the loops of the stages have them.
    struct Mix<'a> {
        from: &'a [f32],
        to: &'a mut [f32],
    }

    impl WideLoop for Mix<'_> {
        #[inline(always)]
        fn run(self) {
            for (to, x) in self.to.iter_mut().zip(self.from) {
                let squared = x * x + 0.1 * x + 0.3;
                *to = if squared > 2.0 { squared.sqrt() / 3.0 } else { squared * 0.7 - x };
            }
        }
    }

    #[test]
    fn a_wide_loop_gives_the_bytes_of_the_plain_one() {
        let from: Vec<f32> = (0..1003).map(|i| (i as f32 - 500.0) * 0.0137).chain([f32::NAN, f32::INFINITY]).collect();
        let [mut wide, mut plain] = [(); 2].map(|()| vec![0.0; from.len()]);
        run_wide(Mix { from: &from, to: &mut wide });
        Mix { from: &from, to: &mut plain }.run();
        let bits = |values: &[f32]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&wide), bits(&plain));
    }
}
