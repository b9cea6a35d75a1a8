//! A digest of all that the mapper has been told: by it a resumed run knows that the recording and the tracker are what they were.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::MapperMessage;

/// Of the messages so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Heard {
    pub messages: usize,
    /// Each is that of the one before and the message.
    digest: [u8; 32],
}

impl Heard {
    pub fn hear(&mut self, message: &MapperMessage) {
        let mut digest = Sha256::new_with_prefix(self.digest);
        match message {
            MapperMessage::Points(points) => points.iter().for_each(|point| {
                digest.update(bytemuck::cast_slice(point.position.as_slice()));
                digest.update(point.color);
            }),
            MapperMessage::PoseUpdate(updates) => digest.update(plain(updates)),
            MapperMessage::Keyframe(keyframe) => {
                let image = &keyframe.image;
                digest.update(plain(&(keyframe.id, keyframe.world_from_camera, &keyframe.covisible, image.pinhole)));
                digest.update(image.color.as_raw());
                image.depth.iter().for_each(|depth| digest.update(bytemuck::cast_slice(&depth.metres)));
            }
        }
        *self = Self { messages: self.messages + 1, digest: digest.finalize().into() };
    }
}

fn plain(value: &impl Serialize) -> Vec<u8> {
    postcard::to_stdvec(value).expect("messages are plain data")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Se3;

    #[test]
    fn order_and_every_bit_count() {
        let update = |id, x| MapperMessage::PoseUpdate(vec![(id, Se3::translation(x, 0.0, 0.0))]);
        let heard = |messages: &[MapperMessage]| {
            let mut heard = Heard::default();
            messages.iter().for_each(|message| heard.hear(message));
            heard
        };
        let one = heard(&[update(1, 0.5), update(2, 0.5)]);
        assert_eq!(one, heard(&[update(1, 0.5), update(2, 0.5)]));
        assert_eq!(one.messages, 2);
        for other in [[update(2, 0.5), update(1, 0.5)], [update(1, 0.5), update(2, 0.5f64.next_up())]] {
            assert_ne!(one.digest, heard(&other).digest);
        }
    }
}
