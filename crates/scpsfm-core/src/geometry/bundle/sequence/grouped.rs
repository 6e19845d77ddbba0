//! Numbers in groups: observations by point or view, points by block.

use std::ops::Range;

/// Numbers in groups, ascending within each.
#[derive(Debug)]
pub(super) struct Grouped {
    /// First member of a group, and at the end the number of members.
    pub starts: Vec<usize>,
    /// One group after the other.
    pub members: Vec<u32>,
}

impl Grouped {
    /// Sorts in linear time.
    ///
    /// * `pairs`: a group and a member of it, members ascending
    pub fn new(groups: usize, pairs: impl Iterator<Item = (usize, usize)> + Clone) -> Self {
        let mut starts = vec![0; groups + 1];
        pairs.clone().for_each(|(group, _)| starts[group + 1] += 1);
        for group in 0..groups {
            starts[group + 1] += starts[group];
        }
        let (mut next, mut members) = (starts.clone(), vec![0; starts[groups]]);
        for (group, member) in pairs {
            members[next[group]] = member as u32;
            next[group] += 1;
        }
        Self { starts, members }
    }

    pub fn of(&self, group: usize) -> &[u32] {
        &self.members[self.starts[group]..self.starts[group + 1]]
    }

    /// Members of a group that are in a range.
    pub fn within(&self, group: usize, range: &Range<usize>) -> &[u32] {
        let all = self.of(group);
        let below = |end: usize| all.partition_point(|&member| (member as usize) < end);
        &all[below(range.start)..below(range.end)]
    }
}
