//! Reading `/metrics` as Prometheus does.

use std::collections::BTreeMap;

/// The samples of one scrape, by series: `name{label="value"}`, the labels in any order.
#[derive(Debug, Clone)]
pub struct Page {
    /// The labels are in the order of their names.
    pub samples: BTreeMap<String, f64>,
}

impl Page {
    /// Reads the samples out of a page.
    pub fn parse(page: &str) -> Self {
        let samples = page.lines().filter(|line| !line.is_empty() && !line.starts_with('#'));
        let samples = samples.map(|line| line.rsplit_once(' ').expect("a series and its value"));
        let samples = samples.map(|(series, value)| (in_order(series), value.parse().expect("a number")));
        Self { samples: samples.collect() }
    }

    /// Value of one series. One that does not exist fails the test: a misspelt name must not pass for an idle server.
    pub fn value(&self, series: &str) -> f64 {
        *self.samples.get(&in_order(series)).unwrap_or_else(|| panic!("no series {series}"))
    }

    /// Value of a series that appears with its first sample; 0 before. Only for what is to be waited for or compared
    /// with a later [`Page::value`], which tells whether the name is right.
    pub fn value_so_far(&self, series: &str) -> f64 {
        self.samples.get(&in_order(series)).copied().unwrap_or(0.0)
    }

    /// Sum over every series of that name, whatever its labels; there must be one.
    pub fn sum(&self, name: &str) -> f64 {
        let of_name =
            |series: &str| series.strip_prefix(name).is_some_and(|rest| rest.is_empty() || rest.starts_with('{'));
        let mut values = self.samples.iter().filter(|(series, _)| of_name(series)).map(|(_, value)| value).peekable();
        assert!(values.peek().is_some(), "no series of {name}");
        values.sum()
    }
}

/// A series with its labels in the order of their names. No value of ours holds a comma.
fn in_order(series: &str) -> String {
    let Some((name, labels)) = series.split_once('{') else { return series.to_owned() };
    let mut labels: Vec<&str> = labels.trim_end_matches('}').split(',').collect();
    labels.sort_unstable();
    format!("{name}{{{}}}", labels.join(","))
}
