//! A digest of the mapper's input: a resumed run compares it to verify that recording and tracking have repeated.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::mapping::{InitialMap, MapperMessage};

/// Running SHA-256 over the messages so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct MessageDigest {
    /// Messages so far.
    pub messages: usize,
    /// Each is that of the one before and the message.
    digest: [u8; 32],
}

impl MessageDigest {
    /// Appends one message.
    pub fn update(&mut self, message: &MapperMessage) {
        let mut digest = Sha256::new_with_prefix(self.digest);
        match message {
            MapperMessage::Points(points) => points.iter().for_each(|point| {
                digest.update(bytemuck::cast_slice(point.position.as_slice()));
                digest.update(point.color);
            }),
            MapperMessage::Map(InitialMap { cloud: map, frozen }) => {
                digest.update(plain(frozen));
                [&map.means, &map.log_scales, &map.sh].into_iter().for_each(|values| digest.update(bytemuck::cast_slice(values)));
                digest.update(bytemuck::cast_slice(&map.rotations));
                digest.update(bytemuck::cast_slice(&map.raw_opacities));
            }
            MapperMessage::PoseUpdate(updates) => digest.update(plain(updates)),
            MapperMessage::Remove(keyframes) => digest.update(plain(keyframes)),
            MapperMessage::Keyframe(keyframe) => {
                let image = &keyframe.image;
                digest.update(plain(&(keyframe.id, keyframe.world_from_camera, &keyframe.covisible, image.pinhole)));
                digest.update(image.color.as_raw());
                image.valid.iter().for_each(|valid| digest.update(bytemuck::cast_slice::<bool, u8>(valid)));
                digest.update(plain(&keyframe.exposure));
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
    use crate::mapping::PoseUpdate;

    #[test]
    fn order_and_every_bit_count() {
        let scaled_update = |keyframe, x, scale| {
            MapperMessage::PoseUpdate(vec![PoseUpdate { keyframe, world_from_camera: Se3::translation(x, 0.0, 0.0), scale }])
        };
        let pose_update = |keyframe, x| scaled_update(keyframe, x, 1.0);
        let digest_of = |messages: &[MapperMessage]| {
            let mut digest = MessageDigest::default();
            messages.iter().for_each(|message| digest.update(message));
            digest
        };
        let one = digest_of(&[pose_update(1, 0.5), pose_update(2, 0.5)]);
        assert_eq!(one, digest_of(&[pose_update(1, 0.5), pose_update(2, 0.5)]));
        assert_eq!(one.messages, 2);
        for other in [
            [pose_update(2, 0.5), pose_update(1, 0.5)],
            [pose_update(1, 0.5), pose_update(2, 0.5f64.next_up())],
            [pose_update(1, 0.5), scaled_update(2, 0.5, 1.0f64.next_up())],
        ] {
            assert_ne!(one.digest, digest_of(&other).digest);
        }
    }
}
