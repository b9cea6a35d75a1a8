//! Lists of plain numbers as serde's bytes, so that large ones are written and read at once: `#[serde(with = "plain")]`.
//!
//! In the byte order of the machine, like everything that the GPU reads.

use bytemuck::{AnyBitPattern, NoUninit, pod_read_unaligned};
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serializer};

/// Writes the numbers as bytes.
///
/// # Errors
/// The serializer's own.
pub fn serialize<T: NoUninit, S: Serializer>(values: &[T], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_bytes(bytemuck::cast_slice(values))
}

/// Reads the numbers from bytes.
///
/// # Errors
/// The deserializer's own, or a length that is no whole number of values.
pub fn deserialize<'de, T: AnyBitPattern, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<T>, D::Error> {
    let values = <&[u8]>::deserialize(deserializer)?.chunks_exact(std::mem::size_of::<T>());
    if !values.remainder().is_empty() {
        return Err(D::Error::custom("a list of numbers ends within one"));
    }
    Ok(values.map(pod_read_unaligned).collect())
}
