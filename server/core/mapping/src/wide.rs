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
