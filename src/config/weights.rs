//! Weights of tenants, as they are written: `acme=3, globex=2`.

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::domain::job::JobName;

/// Largest weight: a thousand jobs for one of another tenant is as good as always.
const MAX_WEIGHT: u32 = 1000;

/// Weights of the tenants that have one of their own.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TenantWeights(pub BTreeMap<String, u32>);

impl FromStr for TenantWeights {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let mut weights = BTreeMap::new();
        for entry in text.split(',').map(str::trim).filter(|entry| !entry.is_empty()) {
            let wrong = || {
                format!(
                    "`{entry}` is no weight of a tenant; right would be TENANT=WEIGHT, each tenant once, with a number \
                     from 1 to {MAX_WEIGHT}"
                )
            };
            let (tenant, weight) = entry.split_once('=').ok_or_else(wrong)?;
            let weight = weight.trim().parse().ok().filter(|weight| (1..=MAX_WEIGHT).contains(weight));
            let tenant = Some(tenant.trim()).filter(|tenant| JobName::is_id(tenant)).ok_or_else(wrong)?;
            if weights.insert(tenant.to_owned(), weight.ok_or_else(wrong)?).is_some() {
                return Err(wrong());
            }
        }
        Ok(Self(weights))
    }
}

impl fmt::Display for TenantWeights {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (number, (tenant, weight)) in self.0.iter().enumerate() {
            write!(f, "{}{tenant}={weight}", if number == 0 { "" } else { ", " })?;
        }
        Ok(())
    }
}

impl Serialize for TenantWeights {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for TenantWeights {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_read_as_they_are_written_and_slips_are_refused() {
        let read: TenantWeights = "acme=3,globex = 1000,".parse().expect("two weights");
        assert_eq!(read.0, BTreeMap::from([("acme".into(), 3), ("globex".into(), 1000)]));
        assert_eq!(read.to_string(), "acme=3, globex=1000");
        assert_eq!(read.to_string().parse(), Ok(read));
        assert_eq!("".parse(), Ok(TenantWeights::default()));
        for slip in ["acme", "acme=", "acme=0", "acme=1001", "acme=-1", "acme=1.5", "Acme=2", "=2", "acme=1,acme=2"] {
            let error = slip.parse::<TenantWeights>().expect_err(slip);
            assert!(error.contains("TENANT=WEIGHT") && error.contains("1000"), "{error}");
        }
    }
}
