//! Counting ids in time that depends on how many are counted, not on how many there are.

use std::cell::RefCell;

thread_local! {
    /// By id; all zero between two calls.
    static COUNTS: RefCell<Vec<u32>> = const { RefCell::new(Vec::new()) };
}

/// The ids and how often each comes, in the order in which they come first.
pub fn tally(ids: impl Iterator<Item = usize>) -> Vec<(usize, usize)> {
    // Taken out, so that the ids may come from another tally.
    let mut counts = COUNTS.take();
    let mut found: Vec<(usize, usize)> = Vec::new();
    for id in ids {
        if id >= counts.len() {
            counts.resize((id + 1).next_power_of_two(), 0);
        }
        if counts[id] == 0 {
            found.push((id, 0));
        }
        counts[id] += 1;
    }
    for (id, count) in &mut found {
        *count = std::mem::take(&mut counts[*id]) as usize;
    }
    COUNTS.set(counts);
    found
}

/// The ids, each once, in the order in which they come first.
pub fn distinct(ids: impl Iterator<Item = usize>) -> Vec<usize> {
    tally(ids).into_iter().map(|(id, _)| id).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_are_counted_in_the_order_of_their_first_mention() {
        assert_eq!(tally([7, 2, 7, 90, 2, 7].into_iter()), [(7, 3), (2, 2), (90, 1)]);
        let nested = tally([1, 3].into_iter().flat_map(|k| distinct([k, 5, k].into_iter())));
        assert_eq!(nested, [(1, 1), (5, 2), (3, 1)]);
        assert!(distinct(std::iter::empty()).is_empty());
    }
}
