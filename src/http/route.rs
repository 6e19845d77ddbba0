//! Which method of the API a request calls. The rules stand in the proto, as `google.api.http` of AIP-127.

use std::ops::Range;

use axum::http::Method;
use axum::http::uri::PathAndQuery;
use prost_reflect::{DescriptorPool, DynamicMessage, MethodDescriptor, ReflectMessage, Value};

/// The annotation that holds a method's rule.
const ANNOTATION: &str = "google.api.http";

/// One way to call one method.
#[derive(Debug, Clone)]
pub struct Route {
    pub verb: Method,
    pub template: Template,
    /// Whether the body is the request; else there is none, and what is not in the path is in the query.
    pub has_body: bool,
    pub method: MethodDescriptor,
    /// Where gRPC has it.
    pub grpc_path: PathAndQuery,
}

/// What a path was found to be.
#[derive(Debug)]
pub enum Found<'a> {
    /// The route, and the fields of its request that the path holds.
    Route(&'a Route, Vec<(&'a str, String)>),
    /// There is such a path for these verbs only.
    OtherVerbs(Vec<Method>),
    Nothing,
}

/// Every route of these descriptors.
///
/// # Errors
/// A rule that is none: a defect of the proto.
pub fn routes(pool: &DescriptorPool) -> Result<Vec<Route>, String> {
    let annotation = pool.get_extension_by_name(ANNOTATION).ok_or_else(|| format!("the proto lacks {ANNOTATION}"))?;
    let mut routes = Vec::new();
    for service in pool.services() {
        for method in service.methods() {
            let options = method.options();
            if !options.has_extension(&annotation) {
                continue;
            }
            let rule = options.get_extension(&annotation);
            let rule = rule.as_message().ok_or_else(|| format!("{}: the rule is no message", method.full_name()))?;
            routes.push(route(&method, rule)?);
        }
    }
    Ok(routes)
}

fn route(method: &MethodDescriptor, rule: &DynamicMessage) -> Result<Route, String> {
    let wrong = |what: String| format!("{}: {what}", method.full_name());
    let verbs = [("get", Method::GET), ("put", Method::PUT), ("post", Method::POST), ("delete", Method::DELETE)];
    let text = |field: &str| rule.get_field_by_name(field).and_then(|value| value.as_str().map(str::to_owned));
    let rules =
        verbs.into_iter().filter_map(|(field, verb)| Some((verb, text(field).filter(|path| !path.is_empty())?)));
    let (verb, path) = rules.into_iter().next().ok_or_else(|| wrong("its rule has no path".into()))?;
    let grpc_path = format!("/{}/{}", method.parent_service().full_name(), method.name());
    Ok(Route {
        verb,
        template: Template::parse(&path).map_err(wrong)?,
        has_body: text("body").is_some_and(|body| body == "*"),
        method: method.clone(),
        grpc_path: grpc_path.parse().map_err(|error| wrong(format!("{grpc_path}: {error}")))?,
    })
}

/// A path with its percent-encoded bytes decoded, once. An encoded `/` is left as it is: decoded it would separate
/// segments, and no name holds one.
///
/// # Errors
/// What is wrong with the encoding.
pub fn decode(path: &str) -> Result<String, &'static str> {
    let mut parts = path.split('%');
    let mut decoded = parts.next().unwrap_or_default().as_bytes().to_vec();
    for part in parts {
        let digits = part.get(..2).filter(|digits| digits.bytes().all(|digit| digit.is_ascii_hexdigit()));
        let byte = digits.and_then(|digits| u8::from_str_radix(digits, 16).ok());
        match byte.ok_or("has a % without two hexadecimal digits after it")? {
            b'/' => decoded.extend_from_slice(b"%2F"),
            byte => decoded.push(byte),
        }
        decoded.extend_from_slice(&part.as_bytes()[2..]);
    }
    String::from_utf8(decoded).map_err(|_| "is not UTF-8 once it is decoded")
}

/// Finds the route of a request.
pub fn find<'a>(routes: &'a [Route], verb: &Method, path: &str) -> Found<'a> {
    let mut others = Vec::new();
    for route in routes {
        let Some(fields) = route.template.fields(path) else { continue };
        if route.verb == *verb {
            return Found::Route(route, fields);
        }
        others.push(route.verb.clone());
    }
    if others.is_empty() { Found::Nothing } else { Found::OtherVerbs(others) }
}

/// The pattern of a path, such as `/v1/{name=tenants/*/jobs/*}:cancel`.
#[derive(Debug, Clone)]
pub struct Template {
    segments: Vec<Segment>,
    /// The fields of the request, and the segments that they are.
    fields: Vec<(String, Range<usize>)>,
    /// What follows the last segment after a colon.
    custom_verb: Option<String>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Segment {
    Literal(String),
    /// Any one segment.
    Any,
}

impl Template {
    /// # Errors
    /// What is wrong with the pattern.
    fn parse(text: &str) -> Result<Self, String> {
        let wrong = || format!("{text:?} is no pattern of a path");
        let mut template = Self { segments: Vec::new(), fields: Vec::new(), custom_verb: None };
        let mut rest = text.strip_prefix('/').ok_or_else(wrong)?;
        loop {
            let after = if let Some(variable) = rest.strip_prefix('{') {
                let (inside, after) = variable.split_once('}').ok_or_else(wrong)?;
                let (field, pattern) = inside.split_once('=').unwrap_or((inside, "*"));
                let begin = template.segments.len();
                template.segments.extend(pattern.split('/').map(segment));
                template.fields.push((field.to_owned(), begin..template.segments.len()));
                after
            } else {
                let end = rest.find(['/', ':']).unwrap_or(rest.len());
                template.segments.push(segment(&rest[..end]));
                &rest[end..]
            };
            if let Some(verb) = after.strip_prefix(':') {
                template.custom_verb = Some(verb.to_owned());
                return Ok(template);
            }
            if after.is_empty() {
                return Ok(template);
            }
            rest = after.strip_prefix('/').ok_or_else(wrong)?;
        }
    }

    /// The fields that a path holds; `None` for a path of another pattern.
    fn fields(&self, path: &str) -> Option<Vec<(&str, String)>> {
        let path = path.strip_prefix('/')?;
        let path = match &self.custom_verb {
            Some(verb) => path.strip_suffix(verb.as_str())?.strip_suffix(':')?,
            None => path,
        };
        let segments: Vec<&str> = path.split('/').collect();
        let fits = |(segment, text): (&Segment, &&str)| match segment {
            Segment::Literal(literal) => literal == text,
            Segment::Any => !text.is_empty() && (self.custom_verb.is_some() || !text.contains(':')),
        };
        if segments.len() != self.segments.len() || !self.segments.iter().zip(&segments).all(fits) {
            return None;
        }
        Some(self.fields.iter().map(|(field, range)| (field.as_str(), segments[range.clone()].join("/"))).collect())
    }

    /// The path with a parameter for each segment that is not fixed, as OpenAPI has it, and the parameters' names: a
    /// segment of `tenants/*` is the `tenant`.
    pub fn parameters(&self) -> (String, Vec<String>) {
        let (mut path, mut names) = (String::new(), Vec::new());
        for (place, segment) in self.segments.iter().enumerate() {
            path.push('/');
            match segment {
                Segment::Literal(literal) => path.push_str(literal),
                Segment::Any => {
                    let single = self.fields.iter().find(|(_, range)| *range == (place..place + 1));
                    let name = match (single, place.checked_sub(1).map(|before| &self.segments[before])) {
                        (Some((field, _)), _) => field.clone(),
                        (None, Some(Segment::Literal(plural))) => plural.trim_end_matches('s').to_owned(),
                        (None, _) => format!("segment{place}"),
                    };
                    path.push_str(&format!("{{{name}}}"));
                    names.push(name);
                }
            }
        }
        if let Some(verb) = &self.custom_verb {
            path.push_str(&format!(":{verb}"));
        }
        (path, names)
    }

    /// The fields of the request that the path holds.
    pub fn held(&self) -> impl Iterator<Item = &str> {
        self.fields.iter().map(|(field, _)| field.as_str())
    }

    /// Whether the path holds this field of the request.
    pub fn holds(&self, field: &str) -> bool {
        self.held().any(|held| held == field)
    }
}

fn segment(text: &str) -> Segment {
    if text == "*" { Segment::Any } else { Segment::Literal(text.to_owned()) }
}

/// Sets a field of a request from the text of a path, a query or a header; under its name in the proto or in JSON.
///
/// # Errors
/// That there is no such field, or what is wrong with the text.
pub fn set_field(message: &mut DynamicMessage, name: &str, text: &str) -> Result<(), String> {
    let descriptor = message.descriptor();
    let field = descriptor.get_field_by_name(name).or_else(|| descriptor.get_field_by_json_name(name));
    let Some(field) = field.filter(|field| !field.is_list() && !field.is_map()) else {
        let known: Vec<_> = descriptor.fields().map(|field| field.json_name().to_owned()).collect();
        return Err(format!("is no parameter; there are {}", known.join(", ")));
    };
    let value = match field.default_value() {
        Value::String(_) => Some(Value::String(text.to_owned())),
        Value::Bool(_) => text.parse().ok().map(Value::Bool),
        Value::I32(_) => text.parse().ok().map(Value::I32),
        Value::I64(_) => text.parse().ok().map(Value::I64),
        Value::U32(_) => text.parse().ok().map(Value::U32),
        Value::U64(_) => text.parse().ok().map(Value::U64),
        _ => None,
    };
    message.set_field(&field, value.ok_or_else(|| format!("{text:?} is not of its type"))?);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_decoded_once_and_keep_their_segments() {
        for (path, decoded) in [
            ("/v1/tenants/%2d/jobs", "/v1/tenants/-/jobs"),
            ("/v1/tenants/-/jobs/ja%3Acancel", "/v1/tenants/-/jobs/ja:cancel"),
            ("/v1/tenants/a%2fjobs%2Fb", "/v1/tenants/a%2Fjobs%2Fb"),
            ("/%25%32%66", "/%2f"),
            ("/%C3%A9", "/\u{e9}"),
            ("", ""),
        ] {
            assert_eq!(decode(path).as_deref(), Ok(decoded), "{path}");
        }
        for bad in ["/%", "/%2", "/a%2/b", "/%zz", "/%+1", "/%\u{e9}", "/%ff"] {
            assert!(decode(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn paths_are_taken_apart_by_their_patterns() {
        let fields = |pattern: &str, path: &str| {
            let template = Template::parse(pattern).expect("a pattern");
            template
                .fields(path)
                .map(|fields| fields.into_iter().map(|(name, text)| format!("{name}={text}")).collect::<Vec<_>>())
        };
        let job = "/v1/{name=tenants/*/jobs/*}";
        assert_eq!(fields(job, "/v1/tenants/a/jobs/b"), Some(vec!["name=tenants/a/jobs/b".into()]));
        for other in
            ["/v1/tenants/a/jobs/b:cancel", "/v1/tenants/a/jobs", "/v1/tenants/a/jobs/", "/v2/tenants/a/jobs/b", "v1"]
        {
            assert_eq!(fields(job, other), None, "{other}");
        }
        let cancel = "/v1/{name=tenants/*/jobs/*}:cancel";
        assert_eq!(fields(cancel, "/v1/tenants/a/jobs/b:cancel"), Some(vec!["name=tenants/a/jobs/b".into()]));
        assert_eq!(fields(cancel, "/v1/tenants/a/jobs/b"), None);
        let upload = "/v1/{parent=tenants/*}/uploads/{upload_id}";
        let expected = vec!["parent=tenants/a".to_owned(), "upload_id=u".to_owned()];
        assert_eq!(fields(upload, "/v1/tenants/a/uploads/u"), Some(expected));
        let (path, names) = Template::parse(upload).expect("a pattern").parameters();
        assert_eq!(
            (path.as_str(), names),
            (
                "/v1/{tenant}/uploads/{upload_id}".replace("{tenant}", "tenants/{tenant}").as_str(),
                vec!["tenant".into(), "upload_id".into()]
            )
        );
        assert!(Template::parse("v1").is_err() && Template::parse("/v1/{name").is_err());
    }
}
