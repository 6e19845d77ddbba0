//! The description of the API over HTTP (OpenAPI 3.1), made of the same descriptors that answer it: paths, parameters
//! and schemas cannot differ from what is served, and the words are the proto's comments.

use std::collections::BTreeSet;

use prost_reflect::{Cardinality, EnumDescriptor, FieldDescriptor, FileDescriptor, Kind, MessageDescriptor};
use serde_json::{Map, Value, json};

use super::download;
use super::route::Route;
use super::upload::PROTOBUF;

/// Annotation of fields (AIP-203), and its values that the description tells.
const BEHAVIOR: &str = "google.api.field_behavior";
const REQUIRED: i32 = 2;
const OUTPUT_ONLY: i32 = 3;
const INPUT_ONLY: i32 = 4;

/// Name of the schema of a refusal.
const ERROR: &str = "Error";

/// The whole document.
pub fn document(routes: &[Route]) -> Value {
    let mut paths = Map::new();
    let held = routes.iter().filter(|route| route.has_body).flat_map(|route| {
        let message = route.method.input().name().to_owned();
        route.template.held().map(move |field| (message.clone(), field.to_owned()))
    });
    let mut schemas = Schemas { in_path: held.collect(), ..Schemas::default() };
    for route in routes {
        let (path, parameters) = route.template.parameters();
        let operation = operation(route, &parameters, &mut schemas);
        let entry = paths.entry(path).or_insert_with(|| json!({}));
        entry[route.verb.as_str().to_ascii_lowercase()] = operation;
    }
    if let Some(pool) = routes.first().map(|route| route.method.parent_pool().clone())
        && let (Some(data), Some(input)) =
            (pool.get_message_by_name("scpsfm.v1.InputData"), pool.get_message_by_name("scpsfm.v1.Input"))
    {
        let entry = paths.entry("/v1/tenants/{tenant}/inputs".to_owned()).or_insert_with(|| json!({}));
        entry["post"] = upload(&data, &input, &mut schemas);
    }
    let mut schemas = schemas.described();
    schemas.insert(ERROR.into(), error_schema());
    json!({
        "openapi": "3.1.0",
        "info": {
            "title": "scpsfm",
            "version": env!("CARGO_PKG_VERSION"),
            "summary": env!("CARGO_PKG_DESCRIPTION"),
            "license": {"name": "MIT OR Apache-2.0", "identifier": "MIT OR Apache-2.0"},
        },
        "servers": [{"url": "/"}],
        "security": [{}, {"key": []}],
        "paths": paths,
        "components": {
            "schemas": schemas,
            "securitySchemes": {"key": {
                "type": "http", "scheme": "bearer",
                "description": "An API key, where the server asks for one; it says of which tenant the caller is.",
            }},
        },
    })
}

fn operation(route: &Route, path_parameters: &[String], schemas: &mut Schemas) -> Value {
    let method = &route.method;
    let mut parameters: Vec<Value> = path_parameters.iter().map(|name| path_parameter(name)).collect();
    if !route.has_body {
        let fields = method.input().fields().filter(|field| !route.template.holds(field.name())).collect::<Vec<_>>();
        parameters.extend(fields.iter().map(|field| query_parameter(field, schemas)));
    }
    let description = comment(&method.parent_service().parent_file(), method.path());
    let mut operation = json!({
        "operationId": format!("{}_{}", method.parent_service().name(), method.name()),
        "tags": [method.parent_service().name()],
        "summary": description.split(". ").next().unwrap_or_default().trim_end_matches('.'),
        "description": description,
        "parameters": parameters,
        "responses": {
            "200": answer_of(route, schemas),
            "default": refusal(),
        },
    });
    if route.has_body {
        let schema = schemas.reference(&method.input());
        operation["requestBody"] = json!({"content": {"application/json": {"schema": schema}}});
    }
    operation
}

fn answer_of(route: &Route, schemas: &mut Schemas) -> Value {
    let schema = schemas.reference(&route.method.output());
    if route.method.is_server_streaming() {
        // OpenAPI 3.1 has no word for a stream of events: the schema is that of each event's data.
        return json!({
            "description": "Server-sent events; each one's data is such a message, its id the number to go on after.",
            "content": {"text/event-stream": {"schema": schema}},
        });
    }
    let mut content = json!({"application/json": {"schema": schema}});
    if download::is_of(route) {
        content[PROTOBUF] = json!({"schema": {"type": "string", "format": "binary"}});
    }
    json!({"description": "The answer.", "content": content})
}

fn upload(data: &MessageDescriptor, input: &MessageDescriptor, schemas: &mut Schemas) -> Value {
    let (data, input) = (schemas.reference(data), schemas.reference(input));
    json!({
        "operationId": "InputService_UploadInput",
        "tags": ["InputService"],
        "summary": "Uploads one input",
        "description": "The body is an InputData; protobuf may be of any size that the server's limits on uploads allow.",
        "parameters": [path_parameter("tenant"), {
            "name": "uploadId", "in": "query", "schema": {"type": "string", "format": "uuid"},
            "description": "Names the upload and its input within the tenant. Left out: the server makes one.",
        }],
        "requestBody": {"required": true, "content": {
            "application/json": {"schema": data},
            // Generators leave a call out that has a body without a schema.
            (PROTOBUF): {"schema": {"type": "string", "format": "binary"}},
        }},
        "responses": {
            "200": {"description": "The input.", "content": {"application/json": {"schema": input}}},
            "default": refusal(),
        },
    })
}

fn refusal() -> Value {
    let schema = json!({"$ref": format!("#/components/schemas/{ERROR}")});
    json!({"description": "An error.", "content": {"application/json": {"schema": schema}}})
}

fn error_schema() -> Value {
    json!({
        "type": "object",
        "description": "A refusal (AIP-193); `details` hold an ErrorInfo with a reason for programs, and a BadRequest or a \
                        RetryInfo.",
        "properties": {"error": {
            "type": "object",
            "properties": {
                "code": {"type": "integer"},
                "message": {"type": "string"},
                "status": {"type": "string"},
                "details": {"type": "array", "items": {"type": "object", "additionalProperties": true}},
            },
            "required": ["code", "message", "status"],
        }},
        "required": ["error"],
    })
}

fn path_parameter(name: &str) -> Value {
    let mut parameter = json!({"name": name, "in": "path", "required": true, "schema": {"type": "string"}});
    if name == "tenant" {
        parameter["description"] = json!("The tenant's id; `-` is the tenant of the caller's key.");
    }
    parameter
}

fn query_parameter(field: &FieldDescriptor, schemas: &mut Schemas) -> Value {
    json!({
        "name": field.json_name(), "in": "query",
        "description": field_comment(field),
        "schema": schemas.of_field(field),
    })
}

/// The schemas that are referred to.
#[derive(Default)]
struct Schemas {
    /// Messages and those of their fields that are in the path.
    in_path: BTreeSet<(String, String)>,
    known: BTreeSet<String>,
    /// Referred to and not described yet.
    pending: Vec<MessageDescriptor>,
    described: Map<String, Value>,
}

impl Schemas {
    fn reference(&mut self, message: &MessageDescriptor) -> Value {
        match message.full_name() {
            "google.protobuf.Timestamp" => return json!({"type": "string", "format": "date-time"}),
            "google.protobuf.Duration" => {
                return json!({"type": "string", "pattern": r"^-?\d+(\.\d{1,9})?s$", "examples": ["90s", "1.5s"]});
            }
            "google.protobuf.Empty" => return json!({"type": "object"}),
            _ => {}
        }
        if self.known.insert(message.name().to_owned()) {
            self.pending.push(message.clone());
        }
        json!({"$ref": format!("#/components/schemas/{}", message.name())})
    }

    fn described(mut self) -> Map<String, Value> {
        while let Some(message) = self.pending.pop() {
            let schema = self.of_message(&message);
            self.described.insert(message.name().to_owned(), schema);
        }
        self.described
    }

    fn of_message(&mut self, message: &MessageDescriptor) -> Value {
        let mut properties = Map::new();
        let mut required = Vec::new();
        for field in message.fields() {
            let behavior = behavior(&field);
            let mut schema = self.of_field(&field);
            let description = field_comment(&field);
            if !description.is_empty() {
                schema["description"] = json!(description);
            }
            if behavior.contains(&OUTPUT_ONLY) {
                schema["readOnly"] = json!(true);
            }
            if behavior.contains(&INPUT_ONLY) {
                schema["writeOnly"] = json!(true);
            }
            let is_in_path = self.in_path.contains(&(message.name().to_owned(), field.name().to_owned()));
            if behavior.contains(&REQUIRED) && !is_in_path {
                required.push(field.json_name().to_owned());
            }
            properties.insert(field.json_name().to_owned(), schema);
        }
        let mut schema = json!({
            "type": "object",
            "description": comment(&message.parent_file(), message.path()),
            "properties": properties,
        });
        if !required.is_empty() {
            schema["required"] = json!(required);
        }
        schema
    }

    fn of_field(&mut self, field: &FieldDescriptor) -> Value {
        if field.is_map() {
            let Kind::Message(entry) = field.kind() else { return json!({}) };
            let value = self.of_kind(&entry.map_entry_value_field().kind());
            return json!({"type": "object", "additionalProperties": value});
        }
        let one = self.of_kind(&field.kind());
        if field.cardinality() == Cardinality::Repeated { json!({"type": "array", "items": one}) } else { one }
    }

    /// A kind in protobuf's canonical JSON: 64-bit integers are strings, bytes base64.
    fn of_kind(&mut self, kind: &Kind) -> Value {
        match kind {
            // NaN and infinities are strings.
            Kind::Double | Kind::Float => json!({"oneOf": [
                {"type": "number"},
                {"type": "string", "enum": ["NaN", "Infinity", "-Infinity"]},
            ]}),
            Kind::Int32 | Kind::Sint32 | Kind::Sfixed32 => json!({"type": "integer", "format": "int32"}),
            Kind::Uint32 | Kind::Fixed32 => json!({"type": "integer", "minimum": 0}),
            Kind::Int64 | Kind::Sint64 | Kind::Sfixed64 => json!({"type": "string", "format": "int64"}),
            Kind::Uint64 | Kind::Fixed64 => json!({"type": "string", "format": "uint64"}),
            Kind::Bool => json!({"type": "boolean"}),
            Kind::String => json!({"type": "string"}),
            Kind::Bytes => json!({"type": "string", "contentEncoding": "base64"}),
            Kind::Message(message) => self.reference(message),
            Kind::Enum(values) => of_enum(values),
        }
    }
}

fn of_enum(values: &EnumDescriptor) -> Value {
    // Examples and not all there are: later versions may know more.
    let names: Vec<_> = values.values().map(|value| value.name().to_owned()).collect();
    json!({"type": "string", "examples": names})
}

fn behavior(field: &FieldDescriptor) -> Vec<i32> {
    let Some(annotation) = field.parent_message().parent_pool().get_extension_by_name(BEHAVIOR) else {
        return Vec::new();
    };
    let options = field.options();
    let values = options.get_extension(&annotation);
    values.as_list().unwrap_or_default().iter().filter_map(|value| value.as_enum_number()).collect()
}

fn field_comment(field: &FieldDescriptor) -> String {
    comment(&field.parent_file(), field.path())
}

/// The comment before what is at this place of a file, its lines joined within each paragraph.
fn comment(file: &FileDescriptor, path: &[i32]) -> String {
    let proto = file.file_descriptor_proto();
    let places = proto.source_code_info.iter().flat_map(|info| &info.location);
    let text = places.filter(|place| place.path == path).find_map(|place| place.leading_comments.clone());
    let text = text.unwrap_or_default();
    let paragraphs = text.split("\n\n").map(|paragraph| {
        let lines: Vec<&str> = paragraph.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
        lines.join(" ")
    });
    paragraphs.filter(|paragraph| !paragraph.is_empty()).collect::<Vec<_>>().join("\n\n")
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use prost_reflect::{DescriptorPool, Kind};

    use super::{OUTPUT_ONLY, behavior};
    use crate::rpc::proto::FILE_DESCRIPTOR_SET;

    #[test]
    fn every_field_of_a_request_says_whether_it_must_be_set() {
        let pool = DescriptorPool::decode(FILE_DESCRIPTOR_SET).expect("the API");
        let inputs = |service: prost_reflect::ServiceDescriptor| {
            service.methods().map(|method| method.input()).collect::<Vec<_>>()
        };
        let mut pending: Vec<_> = pool.services().flat_map(inputs).collect();
        // What is uploaded, and a resource that no request holds.
        pending.extend(
            ["InputData", "Input"].iter().filter_map(|name| pool.get_message_by_name(&format!("scpsfm.v1.{name}"))),
        );
        let mut seen = BTreeSet::new();
        while let Some(message) = pending.pop() {
            if !message.full_name().starts_with("scpsfm.v1.") || !seen.insert(message.name().to_owned()) {
                continue;
            }
            for field in message.fields() {
                let behavior = behavior(&field);
                assert!(!behavior.is_empty(), "{} lacks a field_behavior", field.full_name());
                if let Kind::Message(inner) = field.kind()
                    && !field.is_map()
                    && !behavior.contains(&OUTPUT_ONLY)
                {
                    pending.push(inner);
                }
            }
        }
        for reached in ["SolveSettings", "FocalPrior", "MeasurementMatrixChunk", "UploadFinish", "InputData", "Input"] {
            assert!(seen.contains(reached), "{reached}");
        }
    }
}
