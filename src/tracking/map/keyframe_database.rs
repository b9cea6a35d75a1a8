//! Recognising places: which keyframes show what a frame shows, from binary descriptors alone and without a vocabulary learnt before.
//!
//! A binary search tree over Hamming space that grows with the map, after the idea of Schlegel & Grisetti (*HBST: a Hamming distance
//! embedding binary search tree for feature-based visual place recognition*, RA-L 2018): an inner node tests one bit, a leaf that
//! has become too full is split on the bit that halves it best. Noise flips bits, and a query with one
//! flipped on its way ends in a strange leaf: it finds a part of what there is, which ranks keyframes as well as all of it would.

use crate::tracking::features::descriptor::Descriptor;
use crate::tracking::features::frame_features::Feature;
use crate::tracking::map::tally::tally_votes;
use crate::tracking::map::trim;

/// Descriptors in a leaf before it is split.
const LEAF_CAPACITY: usize = 32;
/// Share of a leaf's descriptors that the smaller side of a split must hold; a leaf of near-duplicates is left whole.
const MIN_SPLIT_SHARE: f64 = 0.2;
/// Hamming distance up to which two descriptors may show the same point.
const MAX_DISTANCE: u32 = 50;

const DESCRIPTOR_BITS: usize = 256;

/// A keyframe, and the share of a frame's features that it shows too: between 0 and 1, 1 for itself.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    pub keyframe: usize,
    pub score: f64,
}

#[derive(Clone, Copy, Debug)]
struct Entry {
    descriptor: Descriptor,
    keyframe: u32,
}

#[derive(Clone, Debug)]
enum Node {
    Leaf(Vec<Entry>),
    /// The children for a bit that is 0 and 1.
    Split {
        bit: usize,
        children: [usize; 2],
    },
}

/// A leaf, and the inner node above it.
struct Place {
    leaf: usize,
    parent: Option<usize>,
}

/// The descriptors of all keyframes.
#[derive(Clone, Debug)]
pub struct KeyframeDatabase {
    /// The root comes first.
    nodes: Vec<Node>,
    /// Number of features, by keyframe; 0 for those that were never inserted.
    features: Vec<usize>,
    /// Pairs of nodes that are no more; their places are used again.
    free: Vec<[usize; 2]>,
}

impl Default for KeyframeDatabase {
    fn default() -> Self {
        Self { nodes: vec![Node::Leaf(Vec::new())], features: Vec::new(), free: Vec::new() }
    }
}

impl KeyframeDatabase {
    /// Takes in a keyframe's features.
    pub fn insert(&mut self, keyframe: usize, features: &[Feature]) {
        self.features.resize(self.features.len().max(keyframe + 1), 0);
        self.features[keyframe] += features.len();
        for feature in features {
            self.insert_entry(Entry { descriptor: feature.descriptor, keyframe: keyframe as u32 });
        }
    }

    /// Forgets a keyframe that was inserted with these features.
    pub fn remove(&mut self, keyframe: usize, features: &[Feature]) {
        if let Some(count) = self.features.get_mut(keyframe) {
            *count = 0;
        }
        for feature in features {
            let Place { leaf, parent } = self.place(&feature.descriptor);
            let Node::Leaf(entries) = &mut self.nodes[leaf] else { continue };
            entries.retain(|e| e.keyframe as usize != keyframe);
            trim(entries);
            if let Some(parent) = parent.filter(|_| entries.is_empty()) {
                self.close(parent, leaf);
            }
        }
    }

    /// Gives up an empty leaf: its sibling takes their parent's place.
    fn close(&mut self, parent: usize, leaf: usize) {
        let Node::Split { children, .. } = self.nodes[parent] else { return };
        let sibling = if children[0] == leaf { children[1] } else { children[0] };
        self.nodes[parent] = std::mem::replace(&mut self.nodes[sibling], Node::Leaf(Vec::new()));
        self.free.push(children);
    }

    /// The keyframes that show some of these features, most alike first, then newest first.
    pub fn query(&self, features: &[Feature]) -> Vec<Similarity> {
        // Each feature has one vote for a keyframe.
        let votes = features.iter().zip(0..).flat_map(|(feature, voter)| {
            let entries =
                if let Node::Leaf(entries) = &self.nodes[self.leaf(&feature.descriptor)] { entries.as_slice() } else { &[] };
            let alike = entries.iter().filter(|entry| entry.descriptor.distance(&feature.descriptor) <= MAX_DISTANCE);
            alike.map(move |entry| (entry.keyframe as usize, voter))
        });
        let score = |keyframe: usize, votes: usize| votes as f64 / self.features[keyframe].max(features.len()) as f64;
        let similarity = |(keyframe, votes)| Similarity { keyframe, score: score(keyframe, votes) };
        let mut ranked: Vec<Similarity> = tally_votes(votes).into_iter().map(similarity).collect();
        ranked.sort_by(|a, b| b.score.total_cmp(&a.score).then(b.keyframe.cmp(&a.keyframe)));
        ranked
    }

    fn insert_entry(&mut self, entry: Entry) {
        let node = self.leaf(&entry.descriptor);
        let Node::Leaf(entries) = &mut self.nodes[node] else { return };
        entries.push(entry);
        // A leaf that could not be split is tried again when it has doubled.
        if entries.len() < LEAF_CAPACITY
            || !(entries.len() / LEAF_CAPACITY).is_power_of_two()
            || entries.len() % LEAF_CAPACITY > 0
        {
            return;
        }
        if let Some(bit) = dividing_bit(entries) {
            let (ones, zeros) = std::mem::take(entries).into_iter().partition(|e| e.descriptor.bit(bit) == 1);
            let next = self.nodes.len();
            let children = self.free.pop().unwrap_or([next, next + 1]);
            self.nodes.resize_with(next.max(children[1] + 1), || Node::Leaf(Vec::new()));
            self.nodes[node] = Node::Split { bit, children };
            (self.nodes[children[0]], self.nodes[children[1]]) = (Node::Leaf(zeros), Node::Leaf(ones));
        }
    }

    /// The leaf that a descriptor leads to.
    fn leaf(&self, descriptor: &Descriptor) -> usize {
        self.place(descriptor).leaf
    }

    fn place(&self, descriptor: &Descriptor) -> Place {
        let mut place = Place { leaf: 0, parent: None };
        while let Node::Split { bit, children } = self.nodes[place.leaf] {
            place = Place { leaf: children[descriptor.bit(bit)], parent: Some(place.leaf) };
        }
        place
    }
}

/// The bit that divides the entries most evenly, the lowest of equals; `None` if none divides them well.
fn dividing_bit(entries: &[Entry]) -> Option<usize> {
    let smaller_side = |bit: usize| {
        let ones = entries.iter().filter(|e| e.descriptor.bit(bit) == 1).count();
        ones.min(entries.len() - ones)
    };
    let (bit, smaller) =
        (0..DESCRIPTOR_BITS).map(|bit| (bit, smaller_side(bit))).max_by_key(|(bit, n)| (*n, DESCRIPTOR_BITS - bit))?;
    (smaller as f64 >= MIN_SPLIT_SHARE * entries.len() as f64).then_some(bit)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tracking::features::frame_features::tests::feature;

    const KEYFRAMES: usize = 60;

    /// KeyframeDatabase of 500 features each; neighbours share a third of theirs, as keyframes of one walk do.
    fn keyframes(random: &mut fastrand::Rng) -> Vec<Vec<Feature>> {
        let random_feature = |random: &mut fastrand::Rng| feature(0.0, 0.0, Descriptor(std::array::from_fn(|_| random.u64(..))));
        let mut all: Vec<Vec<Feature>> = Vec::new();
        for k in 0..KEYFRAMES {
            let mut features: Vec<Feature> = (0..500).map(|_| random_feature(random)).collect();
            if k > 0 {
                let before: Vec<Feature> = all[k - 1][..160].to_vec();
                features[300..460].copy_from_slice(&before);
            }
            all.push(features);
        }
        all
    }

    /// The same place seen again: `flips` bits turned over in each descriptor, and half of the features new.
    fn seen_again(place: &[Feature], flips: usize, random: &mut fastrand::Rng) -> Vec<Feature> {
        let noisy = |(i, f): (usize, &Feature)| {
            let mut descriptor = f.descriptor;
            (0..flips).for_each(|_| descriptor.0[random.usize(0..4)] ^= 1 << random.u32(0..64));
            let strange = Descriptor(std::array::from_fn(|_| random.u64(..)));
            feature(0.0, 0.0, if i % 2 == 0 { descriptor } else { strange })
        };
        place.iter().enumerate().map(noisy).collect()
    }

    #[test]
    fn a_place_is_found_again_through_noise() {
        let mut random = fastrand::Rng::with_seed(4);
        let keyframes = keyframes(&mut random);
        let mut places = KeyframeDatabase::default();
        keyframes.iter().enumerate().for_each(|(k, features)| places.insert(k, features));
        for k in (0..KEYFRAMES).step_by(7) {
            let found = places.query(&seen_again(&keyframes[k], 25, &mut random));
            assert_eq!(found[0].keyframe, k);
            let stranger = found.iter().find(|r| r.keyframe.abs_diff(k) > 1).map_or(0.0, |r| r.score);
            assert!(found[0].score > 0.1 && found[0].score > 10.0 * stranger, "{found:?}");
        }
        let itself = places.query(&keyframes[9])[0];
        assert_eq!((itself.keyframe, itself.score), (9, 1.0));
    }

    #[test]
    fn what_is_not_known_gets_no_votes_and_the_same_input_gives_the_same_answer() {
        let mut random = fastrand::Rng::with_seed(5);
        let keyframes = keyframes(&mut random);
        let build = || {
            let mut places = KeyframeDatabase::default();
            keyframes.iter().enumerate().for_each(|(k, features)| places.insert(3 * k, features));
            places
        };
        let query = seen_again(&keyframes[20], 30, &mut random);
        assert_eq!(build().query(&query), build().query(&query));
        assert_eq!(build().query(&query)[0].keyframe, 60);
        let strange = seen_again(&keyframes[20], 4000, &mut random);
        assert!(build().query(&strange).first().is_none_or(|r| r.score < 0.01));
        assert!(KeyframeDatabase::default().query(&query).is_empty() && build().query(&[]).is_empty());
    }

    #[test]
    fn the_tree_does_not_grow_with_what_has_been_forgotten() {
        let mut random = fastrand::Rng::with_seed(6);
        let keyframes = keyframes(&mut random);
        let mut places = KeyframeDatabase::default();
        // Ever new keyframes, the last three of which stay.
        let mut most = 0;
        for (k, features) in keyframes.iter().enumerate() {
            places.insert(k, features);
            k.checked_sub(3).into_iter().for_each(|old| places.remove(old, &keyframes[old]));
            if k == KEYFRAMES / 3 {
                most = places.nodes.len();
            }
        }
        assert!(places.nodes.len() < 2 * most, "{} nodes after {most}", places.nodes.len());
        assert_eq!(places.query(&keyframes[KEYFRAMES - 2])[0].keyframe, KEYFRAMES - 2);
        (KEYFRAMES - 3..KEYFRAMES).for_each(|k| places.remove(k, &keyframes[k]));
        assert!(matches!(&places.nodes[0], Node::Leaf(entries) if entries.capacity() == 0));
        assert_eq!(places.nodes.len(), 1 + 2 * places.free.len());
        places.insert(KEYFRAMES, &keyframes[0]);
        assert_eq!(places.query(&keyframes[0])[0].keyframe, KEYFRAMES);
    }

    #[test]
    fn many_copies_of_one_descriptor_are_no_harm() {
        let mut places = KeyframeDatabase::default();
        let same = vec![feature(0.0, 0.0, Descriptor([7; 4])); 5000];
        places.insert(0, &same);
        places.insert(1, &same[..100]);
        assert_eq!(places.nodes.len(), 1);
        let found = places.query(&same[..100]);
        assert_eq!((found[0].keyframe, found[0].score, found[1].keyframe), (1, 1.0, 0));
    }
}
