//! Names of uploaded inputs.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::job::JobName;

/// An uploaded input's resource name, `tenants/{tenant}/inputs/{input}`; ids are as those of jobs.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct InputName {
    pub tenant: String,
    pub input: String,
}

impl InputName {
    /// The name of that form.
    pub fn parse(name: &str) -> Option<Self> {
        let (tenant, input) = name.strip_prefix("tenants/")?.split_once("/inputs/")?;
        let both = JobName::is_id(tenant) && JobName::is_id(input);
        both.then(|| Self { tenant: tenant.into(), input: input.into() })
    }
}

impl fmt::Display for InputName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "tenants/{}/inputs/{}", self.tenant, self.input)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_read_as_it_is_written_and_nothing_else_is() {
        let name = InputName::parse("tenants/t/inputs/a-1").expect("a name");
        assert_eq!((name.tenant.as_str(), name.input.as_str()), ("t", "a-1"));
        assert_eq!(name.to_string(), "tenants/t/inputs/a-1");
        for bad in
            ["", "tenants/t/inputs/", "tenants/t/jobs/a", "tenants/t/inputs/a/b", "tenants//inputs/a", "inputs/a"]
        {
            assert_eq!(InputName::parse(bad), None, "{bad}");
        }
    }
}
