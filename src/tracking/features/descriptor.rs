//! 256-bit binary descriptors and their Hamming distance (Rublee et al., *ORB*, ICCV 2011).

/// An ORB descriptor; bit order is OpenCV's, little endian.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Descriptor(pub [u64; 4]);

impl Descriptor {
    /// From OpenCV's 32 bytes; shorter input counts as zeros.
    pub fn from_bytes(bytes: &[u8]) -> Self {
        let mut words = [0u64; 4];
        for (k, byte) in bytes.iter().take(32).enumerate() {
            words[k / 8] |= u64::from(*byte) << (8 * (k % 8));
        }
        Self(words)
    }

    /// The number of differing bits, 0 to 256.
    pub fn distance(&self, other: &Self) -> u32 {
        (0..4).map(|k| (self.0[k] ^ other.0[k]).count_ones()).sum()
    }

    /// Bit number `index` of 256, 0 or 1.
    pub fn bit(&self, index: usize) -> usize {
        (self.0[index / 64] >> (index % 64) & 1) as usize
    }
}

/// The descriptor with the least median distance to all of them: the one that stands best for a landmark. `None` of none.
pub fn representative(descriptors: &[Descriptor]) -> Option<Descriptor> {
    let median_distance = |d: &Descriptor| {
        let mut distances: Vec<u32> = descriptors.iter().map(|other| d.distance(other)).collect();
        distances.sort_unstable();
        distances[(distances.len() - 1) / 2]
    };
    descriptors.iter().min_by_key(|d| median_distance(d)).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distance_counts_bits() {
        let mut bytes = [0u8; 32];
        bytes[0] = 0b101;
        bytes[31] = 0x80;
        assert_eq!(Descriptor::from_bytes(&bytes).distance(&Descriptor::default()), 3);
        assert_eq!(Descriptor([u64::MAX; 4]).distance(&Descriptor::default()), 256);
    }

    #[test]
    fn the_representative_is_the_central_one() {
        let d = |bits: u32| Descriptor([(1u64 << bits) - 1, 0, 0, 0]);
        assert_eq!(representative(&[d(0), d(5), d(12), d(40), d(60)]), Some(d(5)));
        assert_eq!(representative(&[]), None);
    }
}
