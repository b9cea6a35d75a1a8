//! Counting ids in time that depends on how many are counted, not on how many there are.

use std::cell::RefCell;

/// An id's count and who has been counted last.
#[derive(Clone, Copy, Default)]
struct Count {
    count: u32,
    last_voter: u32,
}

thread_local! {
    /// By id; all zero between two calls.
    static COUNTS: RefCell<Vec<Count>> = const { RefCell::new(Vec::new()) };
    /// The number of the latest search for distinct ids, and by id that of the latest that met it.
    static MET: RefCell<(u32, Vec<u32>)> = const { RefCell::new((0, Vec::new())) };
}

/// The ids and how often each comes, in the order in which they come first.
pub fn tally(ids: impl Iterator<Item = usize>) -> Vec<(usize, usize)> {
    tally_votes(ids.zip(0..))
}

/// The ids and how many voters name them, in the order in which they come first. Votes, of an id and a voter, are sorted by voter.
pub fn tally_votes(votes: impl Iterator<Item = (usize, u32)>) -> Vec<(usize, usize)> {
    // Taken out, so that the ids may come from another tally.
    let mut counts = COUNTS.take();
    let mut found: Vec<(usize, usize)> = Vec::new();
    for (id, voter) in votes {
        if id >= counts.len() {
            counts.resize((id + 1).next_power_of_two(), Count::default());
        }
        let Count { count, last_voter } = &mut counts[id];
        if *count == 0 {
            found.push((id, 0));
        } else if *last_voter == voter {
            continue;
        }
        *count += 1;
        *last_voter = voter;
    }
    for (id, count) in &mut found {
        *count = std::mem::take(&mut counts[*id]).count as usize;
    }
    COUNTS.set(counts);
    found
}

/// The ids, each once, in the order in which they come first.
pub fn distinct(ids: impl Iterator<Item = usize>) -> Vec<usize> {
    let (latest, mut met) = MET.take();
    let this = latest.checked_add(1).unwrap_or_else(|| {
        met.fill(0);
        1
    });
    let mut found = Vec::new();
    for id in ids {
        if id >= met.len() {
            met.resize((id + 1).next_power_of_two(), 0);
        }
        if std::mem::replace(&mut met[id], this) != this {
            found.push(id);
        }
    }
    MET.set((this, met));
    found
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
        let nested = distinct([1, 3].into_iter().flat_map(|k| distinct([k, 5, k, 1].into_iter())));
        assert_eq!(nested, [1, 5, 3]);
    }

    #[test]
    fn searches_begin_to_count_anew_when_their_numbers_end() {
        assert_eq!(distinct([1, 2, 1].into_iter()), [1, 2]);
        MET.with_borrow_mut(|(latest, _)| *latest = u32::MAX - 1);
        for _ in 0..3 {
            assert_eq!(distinct([2, 1, 1, 4].into_iter()), [2, 1, 4]);
        }
    }

    #[test]
    fn a_voter_counts_once_for_an_id() {
        let votes = [(7, 0), (2, 0), (7, 0), (7, 1), (2, 3), (7, 3), (7, 3)];
        assert_eq!(tally_votes(votes.into_iter()), [(7, 3), (2, 2)]);
    }
}
