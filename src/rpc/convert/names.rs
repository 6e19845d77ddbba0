//! Resource names in requests, against the tenant that calls.

use crate::domain::error::quoted;
use crate::domain::job::JobName;
use crate::domain::{InputName, InvalidInput, Violation};

/// The tenant of `tenants/{tenant}`.
///
/// # Errors
/// A violation of `parent` where the name has another form.
pub fn tenant(parent: &str) -> Result<String, InvalidInput> {
    match parent.strip_prefix("tenants/") {
        Some(tenant) if JobName::is_id(tenant) => Ok(tenant.to_owned()),
        _ => Err(Violation::of(
            "parent",
            format!("{} is not of the form tenants/{{tenant}}: tenants/default", quoted(parent)),
        )
        .into()),
    }
}

/// The job of `tenants/{tenant}/jobs/{job}`.
///
/// # Errors
/// A violation of `name` where the name has another form.
pub fn job(name: &str) -> Result<JobName, InvalidInput> {
    JobName::parse(name).ok_or_else(|| {
        Violation::of("name", format!("{} is not of the form tenants/{{tenant}}/jobs/{{job}}", quoted(name))).into()
    })
}

/// The input of `tenants/{tenant}/inputs/{input}`.
///
/// # Errors
/// A violation of `field` where the name has another form.
pub fn input(name: &str, field: &str) -> Result<InputName, InvalidInput> {
    InputName::parse(name).ok_or_else(|| {
        let text = format!("{} is not of the form tenants/{{tenant}}/inputs/{{input}}", quoted(name));
        Violation::of(field, text).into()
    })
}

#[cfg(test)]
mod tests {
    #[test]
    fn reads_parents_and_refuses_other_forms() {
        assert_eq!(super::tenant("tenants/default").as_deref(), Ok("default"));
        for bad in ["", "default", "tenants/", "tenants/a/jobs/b", "tenants/A"] {
            let error = super::tenant(bad).expect_err(bad);
            assert_eq!(error.violations()[0].field, "parent", "{bad}");
        }
    }
}
