//! How much one input may hold. The server advertises these and refuses what is larger before storing it.

use serde::{Deserialize, Serialize};

/// Upper bounds of one input.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Limits {
    pub max_views: usize,
    pub max_tracks: usize,
    pub max_observations: usize,
}

impl Default for Limits {
    /// 2,000 views and four million observations: twice the longest sequences in sight, some 100 MB of input.
    fn default() -> Self {
        Self { max_views: 2_000, max_tracks: 1_000_000, max_observations: 4_000_000 }
    }
}
