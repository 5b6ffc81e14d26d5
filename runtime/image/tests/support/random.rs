//! Random numbers for tests, the same on every platform.

/// A linear congruential generator with Knuth's MMIX constants.
#[derive(Clone)]
pub struct Random(pub u64);

impl Random {
    /// Returns a number that is uniform in -1..1.
    pub fn next(&mut self) -> f32 {
        self.0 = self
            .0
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (self.0 >> 40) as f32 / (1_u64 << 23) as f32 - 1.0
    }

    pub fn vec(&mut self, len: usize, scale: f32) -> Vec<f32> {
        (0..len).map(|_| self.next() * scale).collect()
    }
}
