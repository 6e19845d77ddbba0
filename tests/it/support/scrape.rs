//! Reading `/metrics` as Prometheus does.

use std::collections::BTreeMap;

/// The samples of one scrape, by series as it stands on the page: `name{label="value"}`.
#[derive(Debug, Clone)]
pub struct Page {
    samples: BTreeMap<String, f64>,
}

impl Page {
    /// Reads our samples out of a page.
    pub fn parse(page: &str) -> Self {
        let samples = page.lines().filter(|line| line.starts_with("scpsfm_"));
        let samples = samples.map(|line| line.rsplit_once(' ').expect("a series and its value"));
        let samples = samples.map(|(series, value)| (series.to_owned(), value.parse().expect("a number")));
        Self { samples: samples.collect() }
    }

    /// Value of one series; 0 where it does not exist yet.
    pub fn value(&self, series: &str) -> f64 {
        self.samples.get(series).copied().unwrap_or(0.0)
    }

    /// Value of a series that exists from the first scrape on.
    pub fn gauge(&self, series: &str) -> f64 {
        *self.samples.get(series).unwrap_or_else(|| panic!("no series {series}"))
    }

    /// Sum over every series of that name, whatever its labels.
    pub fn sum(&self, name: &str) -> f64 {
        let of_name =
            |series: &str| series.strip_prefix(name).is_some_and(|rest| rest.is_empty() || rest.starts_with('{'));
        self.samples.iter().filter(|(series, _)| of_name(series)).map(|(_, value)| value).sum()
    }
}
