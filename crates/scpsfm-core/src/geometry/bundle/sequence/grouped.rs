//! Numbers in groups: observations by view, points by block.

use std::ops::Range;

/// The members of each group, in the order of the pairs.
///
/// * `pairs`: a group and a member of it
pub(super) fn grouped(groups: usize, pairs: impl Iterator<Item = (usize, usize)>) -> Vec<Vec<u32>> {
    let mut grouped = vec![Vec::new(); groups];
    for (group, member) in pairs {
        grouped[group].push(member as u32);
    }
    grouped
}

/// Those of a group's members, ascending, that are in a range.
pub(super) fn within<'a>(members: &'a [u32], range: &Range<usize>) -> &'a [u32] {
    let below = |end: usize| members.partition_point(|&member| (member as usize) < end);
    &members[below(range.start)..below(range.end)]
}
