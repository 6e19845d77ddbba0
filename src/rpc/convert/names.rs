//! Resource names in requests, against the tenant that calls: `tenants/-` names that one.

use std::borrow::Cow;

use crate::domain::error::quoted;
use crate::domain::job::JobName;
use crate::domain::{InputName, InvalidInput, Violation};

/// The tenant of `tenants/{tenant}`; `own` where that is left out.
///
/// # Errors
/// A violation of `parent` where the name has another form.
pub fn tenant(parent: &str, own: &str) -> Result<String, InvalidInput> {
    if parent.is_empty() {
        return Ok(own.to_owned());
    }
    match parent.strip_prefix("tenants/") {
        Some("-") => Ok(own.to_owned()),
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
pub fn job(name: &str, own: &str) -> Result<JobName, InvalidInput> {
    JobName::parse(&resolved(name, own)).ok_or_else(|| {
        Violation::of("name", format!("{} is not of the form tenants/{{tenant}}/jobs/{{job}}", quoted(name))).into()
    })
}

/// The input of `tenants/{tenant}/inputs/{input}`.
///
/// # Errors
/// A violation of `field` where the name has another form.
pub fn input(name: &str, field: &str, own: &str) -> Result<InputName, InvalidInput> {
    InputName::parse(&resolved(name, own)).ok_or_else(|| {
        let text = format!("{} is not of the form tenants/{{tenant}}/inputs/{{input}}", quoted(name));
        Violation::of(field, text).into()
    })
}

/// A name with the tenant's id in the place of `-`.
pub fn resolved<'a>(name: &'a str, own: &str) -> Cow<'a, str> {
    match name.strip_prefix("tenants/-") {
        Some(rest) if rest.is_empty() || rest.starts_with('/') => format!("tenants/{own}{rest}").into(),
        _ => name.into(),
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn reads_parents_and_refuses_other_forms() {
        assert_eq!(super::tenant("tenants/default", "own").as_deref(), Ok("default"));
        for own in ["", "tenants/-"] {
            assert_eq!(super::tenant(own, "own").as_deref(), Ok("own"));
        }
        for bad in ["default", "-", "tenants/", "tenants/a/jobs/b", "tenants/A"] {
            let error = super::tenant(bad, "own").expect_err(bad);
            assert_eq!(error.violations()[0].field, "parent", "{bad}");
        }
    }

    #[test]
    fn a_dash_is_the_tenant_that_calls() {
        assert_eq!(super::resolved("tenants/-", "own"), "tenants/own");
        let job = super::job("tenants/-/jobs/a", "own").expect("a name");
        assert_eq!(job.to_string(), "tenants/own/jobs/a");
        let input = super::input("tenants/-/inputs/b", "input", "own").expect("a name");
        assert_eq!(input.to_string(), "tenants/own/inputs/b");
        for bad in ["tenants/-", "tenants/-/jobs/-", "tenants/-/jobs/", "tenants/--/jobs/a", "-/jobs/a"] {
            assert_eq!(super::job(bad, "own").expect_err(bad).violations()[0].field, "name", "{bad}");
        }
    }
}
