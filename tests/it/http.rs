//! JSON over HTTP, from outside: a real server, and a client that knows nothing but HTTP.

use std::collections::BTreeSet;
use std::io::Write;
use std::net::TcpStream;
use std::process::Stdio;

use prost::Message as _;
use scpsfm::rpc::proto;
use serde_json::{Value, json};

use crate::support::http::{Answer, get, path_of, post, request, request_for, tracks};
use crate::support::program::Serving;
use crate::support::scrape::Page;
use crate::support::wire::track_set;

/// A key of each of two tenants.
const NORTH: &str = "north-0123456789abcdef0123456789abcdef";
const SOUTH: &str = "south-0123456789abcdef0123456789abcdef";
const OPS: &str = "ops-0123456789abcdef0123456789abcdef";

fn serving() -> (tempfile::TempDir, Serving) {
    let data = tempfile::tempdir().expect("a temporary directory");
    let server = Serving::start(data.path());
    (data, server)
}

#[test]
fn a_job_is_created_watched_read_and_removed_by_http_alone() {
    let (_data, server) = serving();
    let job = json!({"trackSet": tracks(), "job": {"settings": {"seed": "7"}, "labels": {"site": "north"}}});
    let created = post(&server, "/v1/tenants/-/jobs", &job);
    assert_eq!(created.code, 200, "{}", created.text());
    let (created, path) = (created.json(), path_of(&created.json()));
    assert_eq!((created["observationCount"].as_u64(), created["settings"]["seed"].as_str()), (Some(12), Some("7")));
    let watched = get(&server, &format!("{path}/events"));
    assert!(watched.has("content-type: text/event-stream"), "{}", watched.head);
    let events = watched.text();
    let ids: Vec<u64> = events.lines().filter_map(|line| line.strip_prefix("id: ")?.parse().ok()).collect();
    assert_eq!(ids, (1..=ids.len() as u64).collect::<Vec<_>>(), "{events}");
    assert!(events.contains("event: stateChange\n") && events.contains("JOB_STATE_SUCCEEDED"), "{events}");
    let later = request(&server, "GET", &format!("{path}/events"), &[("last-event-id", "2")], &[]).text();
    assert!(later.contains("id: 3\n") && !later.contains("id: 2\n"), "{later}");
    assert!(events.contains("event: summary\n"), "{events}");
    a_browser_that_has_every_event_is_told_to_stop(&server, &path, ids.len());
    let result = get(&server, &format!("{path}/result")).json();
    assert_eq!((result["views"].as_array().map(Vec::len), &result["views"][0]["name"]), (Some(3), &json!("a.jpg")));
    let listed = get(&server, "/v1/tenants/default/jobs?pageSize=5&filter=labels.site+%3D+%22north%22").json();
    assert_eq!(listed["jobs"].as_array().map(Vec::len), Some(1), "{listed}");
    let cancelled = request(&server, "POST", &format!("{path}:cancel"), &[], &[]);
    assert_eq!(cancelled.json()["state"], "JOB_STATE_SUCCEEDED", "one that has ended is answered as it is");
    assert_eq!(request(&server, "DELETE", &path, &[], &[]).code, 200);
    let gone = get(&server, &path);
    assert_eq!((gone.code, gone.refusal().0.as_str()), (404, "JOB_NOT_FOUND"));
    let capabilities = get(&server, "/v1/capabilities").json();
    assert_eq!(capabilities["serverVersion"], env!("CARGO_PKG_VERSION"));
}

/// An `EventSource` reconnects whenever a stream ends; 204 ends that.
fn a_browser_that_has_every_event_is_told_to_stop(server: &Serving, path: &str, last: usize) {
    let after = |id: usize| {
        let id = id.to_string();
        request(server, "GET", &format!("{path}/events"), &[("last-event-id", id.as_str())], &[])
    };
    let (told, more) = (after(last), after(last - 1));
    assert_eq!((told.code, told.body.len()), (204, 0), "{}", told.head);
    assert!(more.code == 200 && more.text().contains(&format!("id: {last}\n")), "{}", more.text());
    assert_eq!(get(server, &format!("{path}/events?afterSequence={last}")).code, 204);
    let unknown = request(server, "GET", "/v1/tenants/-/jobs/none/events", &[("last-event-id", "3")], &[]);
    assert_eq!((unknown.code, unknown.refusal().0.as_str()), (404, "JOB_NOT_FOUND"));
}

/// The count of a reason on the page of metrics.
fn refused(server: &Serving, reason: &str) -> f64 {
    Page::parse(&server.page("/metrics")).value(&format!("scpsfm_http_refused_total{{reason=\"{reason}\"}}"))
}

#[test]
fn head_is_answered_as_get_and_other_methods_name_those_that_are_allowed() {
    let (_data, server) = serving();
    let job = post(&server, "/v1/tenants/-/jobs", &json!({"trackSet": tracks()})).json();
    get(&server, &format!("{}/events", path_of(&job)));
    let (jobs, inputs) = ("/v1/tenants/-/jobs", "/v1/tenants/-/inputs");
    let (job, result) = (path_of(&job), format!("{}/result", path_of(&job)));
    let cancel = format!("{job}:cancel");
    let read_only = ["/", "/console.js", "/openapi.json", "/v1/capabilities", result.as_str()];
    for path in read_only.into_iter().chain([jobs, inputs, job.as_str()]) {
        let (whole, head) = (get(&server, path), request(&server, "HEAD", path, &[], &[]));
        assert_eq!((whole.code, head.code, head.body.len()), (200, 200, 0), "{path}: {}", head.head);
        assert_eq!(head.header("content-length"), whole.body.len().to_string(), "{path}");
        assert_eq!(head.header("content-type"), whole.header("content-type"), "{path}");
    }
    let events = request(&server, "HEAD", &format!("{job}/events"), &[], &[]);
    assert!((events.code, events.body.len()) == (200, 0) && events.has("content-type: text/event-stream"));
    let before = refused(&server, "METHOD_NOT_ALLOWED");
    let others = [
        (jobs, "POST, GET, HEAD"),
        (inputs, "POST, GET, HEAD"),
        (job.as_str(), "GET, DELETE, HEAD"),
        (cancel.as_str(), "POST"),
    ];
    let refusals: Vec<_> = others.into_iter().chain(read_only.map(|path| (path, "GET, HEAD"))).collect();
    for &(path, allowed) in &refusals {
        let answer = request(&server, "PATCH", path, &[], &[]);
        assert_eq!((answer.code, answer.refusal().0.as_str()), (405, "METHOD_NOT_ALLOWED"), "{path}");
        let told = answer.header("allow");
        let methods = |text: &str| text.split(", ").map(str::to_owned).collect::<BTreeSet<_>>();
        assert_eq!(methods(&told), methods(allowed), "{path}");
    }
    assert_eq!(request(&server, "HEAD", &cancel, &[], &[]).code, 405, "no GET, no HEAD");
    assert_eq!(refused(&server, "METHOD_NOT_ALLOWED") - before, 1.0 + refusals.len() as f64);
}

#[test]
fn what_is_wrong_is_told_by_field_and_nothing_is_stored() {
    let (_data, server) = serving();
    let jobs = "/v1/tenants/default/jobs";
    let with = |change: &dyn Fn(&mut Value)| {
        let mut set = tracks();
        change(&mut set);
        json!({"trackSet": set})
    };
    for (body, field) in [
        (with(&|set| set["xs"][7] = json!("NaN")), "track_set.xs[7]"),
        (with(&|set| set["trackCount"] = json!(4_294_967_295_u32)), "track_set.track_count"),
        (with(&|set| set["views"][1]["name"] = json!("a.jpg")), "track_set.views[1].name"),
        (with(&|set| set["sigma"] = json!([])), "body"),
        (with(&|set| set["xs"][0] = json!("five")), "body"),
        (with(&|set| set["trackCount"] = json!(-1)), "body"),
        (json!({"trackSet": tracks(), "job": {"settings": {"method": "METHOD_MAGIC"}}}), "body"),
        (json!([1]), "body"),
        (json!({}), "source"),
    ] {
        let before = refused(&server, "INVALID_ARGUMENT");
        let answer = post(&server, jobs, &body);
        assert_eq!((answer.code, answer.refusal()), (400, ("INVALID_ARGUMENT".into(), field.into())), "{body}");
        let counted = refused(&server, "INVALID_ARGUMENT") - before;
        assert_eq!(counted, f64::from(u8::from(field == "body")), "calls count what they refuse: {body}");
    }
    let json = [("content-type", "application/json")];
    let cut = request(&server, "POST", jobs, &json, b"{\"trackSet\": {");
    assert_eq!((cut.code, cut.refusal().1.as_str()), (400, "body"));
    let twice = request(&server, "POST", jobs, &json, br#"{"input": "a", "job": {"priority": 1, "priority": 2}}"#);
    assert_eq!((twice.code, twice.refusal().1.as_str()), (400, "body"));
    assert!(String::from_utf8_lossy(&twice.body).contains("`priority` is given twice"), "{:?}", twice.body);
    let deep = format!("{{\"job\": {{\"labels\": {}", "[".repeat(100_000));
    let deep = request(&server, "POST", jobs, &json, deep.as_bytes());
    assert_eq!((deep.code, deep.refusal().1.as_str()), (400, "body"));
    let unread = get(&server, "/v1/tenants/default/jobs?pageSize=many");
    assert_eq!((unread.code, unread.refusal().1.as_str()), (400, "pageSize"));
    let unknown = get(&server, "/v1/tenants/default/jobs?page=1");
    assert_eq!((unknown.code, unknown.refusal().1.as_str()), (400, "page"));
    let rebound = request_for(&server, "evil.example", "GET", jobs, &[("origin", "http://evil.example")], &[]);
    assert_eq!((rebound.code, rebound.refusal().0.as_str()), (403, "HOST_REFUSED"));
    for (answer, code, reason) in [
        (request(&server, "POST", jobs, &[("content-type", "text/plain")], b"{}"), 415, "UNSUPPORTED_MEDIA_TYPE"),
        (
            request(&server, "POST", jobs, &[json[0], ("content-encoding", "gzip")], b"{}"),
            415,
            "UNSUPPORTED_MEDIA_TYPE",
        ),
        (
            request(&server, "POST", jobs, &[json[0], ("content-encoding", "Identity, br")], b"{}"),
            415,
            "UNSUPPORTED_MEDIA_TYPE",
        ),
        (request(&server, "POST", jobs, &[json[0], ("content-encoding", "Identity")], b"{}"), 400, "INVALID_ARGUMENT"),
        (request(&server, "PUT", jobs, &json, b"{}"), 405, "METHOD_NOT_ALLOWED"),
        (get(&server, "/v1/nothing"), 404, "PATH_NOT_FOUND"),
        (get(&server, "/v1/tenants/default/jobs/none"), 404, "JOB_NOT_FOUND"),
        (get(&server, "/v1/tenants/A/jobs"), 400, "INVALID_ARGUMENT"),
        (request(&server, "GET", jobs, &[("origin", "https://elsewhere.example")], &[]), 403, "ORIGIN_REFUSED"),
        (
            post(&server, "/v1/tenants/default/jobs?requestId=r", &json!({"trackSet": tracks()})),
            400,
            "INVALID_ARGUMENT",
        ),
    ] {
        assert_eq!((answer.code, answer.refusal().0.as_str()), (code, reason), "{}", answer.text());
    }
    for reason in ["HOST_REFUSED", "ORIGIN_REFUSED", "UNSUPPORTED_MEDIA_TYPE", "METHOD_NOT_ALLOWED", "PATH_NOT_FOUND"] {
        let times = if reason == "UNSUPPORTED_MEDIA_TYPE" { 3.0 } else { 1.0 };
        assert_eq!(refused(&server, reason), times, "{reason}");
    }
    assert!(request(&server, "PUT", jobs, &json, b"{}").has("allow: "), "says which verbs there are");
    assert_eq!(get(&server, jobs).json(), json!({}), "nothing was stored");
}

#[test]
fn a_body_that_names_another_resource_than_the_path_is_refused() {
    let (_data, server) = serving();
    let created = post(&server, "/v1/tenants/-/jobs", &json!({"trackSet": tracks(), "parent": "tenants/default"}));
    assert_eq!(created.code, 200, "{}", created.text());
    let job = path_of(&created.json());
    let of_caller = job.replace("tenants/default", "tenants/-");
    let name = &created.json()["name"];
    let other = "tenants/default/jobs/other";
    let refused = |path: &str, body: &Value, field: &str| {
        let answer = post(&server, path, body);
        assert_eq!((answer.code, answer.refusal()), (400, ("INVALID_ARGUMENT".into(), field.into())), "{body}");
    };
    for parent in ["tenants/acme", "default"] {
        refused("/v1/tenants/-/jobs", &json!({"trackSet": tracks(), "parent": parent}), "parent");
        let batch = json!({"parent": parent, "requests": [{"trackSet": tracks()}]});
        refused("/v1/tenants/default/jobs:batchCreate", &batch, "parent");
    }
    for path in [&job, &of_caller] {
        refused(&format!("{path}:cancel"), &json!({"name": other}), "name");
        refused(&format!("{path}:setPriority"), &json!({"name": other, "priority": 1}), "name");
        // The same by another spelling.
        for same in [name.clone(), json!(of_caller.trim_start_matches("/v1/")), json!("")] {
            assert_eq!(post(&server, &format!("{path}:cancel"), &json!({"name": same})).code, 200, "{same}");
        }
    }
    // A priority that is left out is not 0.
    for body in [json!({}), json!({"name": name}), json!({"priority": null})] {
        refused(&format!("{job}:setPriority"), &body, "priority");
    }
    let none = request(&server, "POST", &format!("{job}:setPriority"), &[], &[]);
    assert_eq!((none.code, none.refusal().1.as_str()), (400, "priority"));
    let listed = get(&server, "/v1/tenants/-/jobs").json();
    assert_eq!(listed["jobs"].as_array().map(Vec::len), Some(1), "{listed}");
}

#[test]
fn paths_and_media_types_are_read_in_every_spelling() {
    let (_data, server) = serving();
    let body = json!({"trackSet": tracks()}).to_string();
    for kind in ["application/JSON", "Application/Json; charset=UTF-8", "application/json;charset=utf-8"] {
        let created = request(&server, "POST", "/v1/tenants/%2d/jobs", &[("content-type", kind)], body.as_bytes());
        assert_eq!(created.code, 200, "{kind}: {}", created.text());
    }
    let data = Some(proto::input_data::Data::TrackSet(track_set()));
    let bytes = proto::InputData { data }.encode_to_vec();
    let kind = [("content-type", "Application/X-Protobuf; messageType=scpsfm.v1.InputData")];
    let uploaded = request(&server, "POST", "/v1/tenants/%64efault/inputs", &kind, &bytes);
    assert_eq!(uploaded.code, 200, "{}", uploaded.text());
    let created = post(&server, "/v1/tenants/-/jobs%3AbatchCreate", &json!({"requests": [{"trackSet": tracks()}]}));
    assert_eq!(created.code, 200, "{}", created.text());
    let job = path_of(&created.json()["jobs"][0]);
    assert_eq!(post(&server, &format!("{job}%3acancel"), &json!({})).code, 200);
    // An encoded slash is part of a segment, and no id has one; what is decoded is not decoded again.
    for odd in ["/v1/tenants/default%2Fjobs", "/v1/tenants/a%2fb/jobs", "/v1/tenants/%252d/jobs"] {
        let answer = get(&server, odd);
        assert!([400, 404].contains(&answer.code), "{odd}: {}", answer.text());
    }
    for bad in ["/v1/tenants/%/jobs", "/v1/tenants/%2/jobs", "/v1/tenants/%zz/jobs", "/v1/tenants/%ff/jobs"] {
        let answer = get(&server, bad);
        assert_eq!((answer.code, answer.refusal()), (400, ("INVALID_ARGUMENT".into(), "path".into())), "{bad}");
    }
}

#[test]
fn a_body_is_bounded_and_costs_its_own_connection() {
    let data = tempfile::tempdir().expect("a temporary directory");
    let bound = [("SCPSFM_HTTP__MAX_BODY_BYTES", "10000")];
    let server = Serving::start_with(data.path(), &bound, std::process::Stdio::null());
    let large = vec![b' '; 1 << 20];
    let json = [("content-type", "application/json")];
    let refused = request(&server, "POST", "/v1/tenants/-/jobs", &json, &large);
    assert_eq!((refused.code, refused.refusal().0.as_str()), (413, "MESSAGE_TOO_LARGE"));
    assert_eq!(self::refused(&server, "MESSAGE_TOO_LARGE"), 1.0);
    // One that says more than it sends, and one that says nothing, hold up nobody.
    let address = server.http.strip_prefix("http://").expect("an address");
    let mut silent: Vec<TcpStream> = (0..50).map(|_| TcpStream::connect(address).expect("connects")).collect();
    for connection in &mut silent {
        connection
            .write_all(b"POST /v1/tenants/-/jobs HTTP/1.1\r\nhost: a\r\ncontent-length: 900\r\n\r\n{")
            .expect("sent");
    }
    assert_eq!(post(&server, "/v1/tenants/-/jobs", &json!({"trackSet": tracks()})).code, 200);
}

#[test]
fn a_body_of_more_objects_than_the_memory_holds_is_refused_unread() {
    let (_data, server) = serving();
    // Decoded, each of the three bytes would be hundreds.
    let objects = "{},".repeat(2_000_000);
    let json = [("content-type", "application/json")];
    for (path, begin) in [("jobs", "{\"trackSet\":{\"views\":["), ("jobs:batchCreate", "{\"requests\":[")] {
        let body = format!("{begin}{objects}");
        let refused = request(&server, "POST", &format!("/v1/tenants/-/{path}"), &json, body.as_bytes());
        assert_eq!((refused.code, refused.refusal().0.as_str()), (413, "MESSAGE_TOO_LARGE"), "{path}");
    }
    assert_eq!(Page::parse(&server.page("/metrics")).value("scpsfm_inflight_bytes"), 0.0, "nothing is held");
    assert_eq!(post(&server, "/v1/tenants/-/jobs", &json!({"trackSet": tracks()})).code, 200);
}

#[test]
fn an_input_is_uploaded_as_json_or_protobuf_and_solved() {
    let (_data, server) = serving();
    let by_json = post(
        &server,
        "/v1/tenants/-/inputs?uploadId=0195fa4c-0000-7000-8000-000000000001",
        &json!({"trackSet": tracks()}),
    );
    assert_eq!(by_json.code, 200, "{}", by_json.text());
    let data = Some(proto::input_data::Data::TrackSet(track_set()));
    let bytes = proto::InputData { data }.encode_to_vec();
    let protobuf = [("content-type", "application/x-protobuf")];
    let by_protobuf = request(&server, "POST", "/v1/tenants/-/inputs", &protobuf, &bytes);
    assert_eq!(by_protobuf.json()["sizeBytes"], bytes.len().to_string(), "{}", by_protobuf.text());
    // Sent again, as after an answer that was lost: it is the same input, and nothing is sent twice.
    let named = format!(
        "/v1/tenants/-/inputs?uploadId={}",
        by_protobuf.json()["name"].as_str().expect("a name").rsplit('/').next().expect("an id")
    );
    let again = request(&server, "POST", &named, &protobuf, &bytes);
    assert_eq!(again.json(), by_protobuf.json(), "{}", again.text());
    // Other bytes of the same length under the same id are refused, whichever way they come.
    let mut other = track_set();
    other.xs[0] += 1.0;
    let other = proto::InputData { data: Some(proto::input_data::Data::TrackSet(other)) }.encode_to_vec();
    assert_eq!(other.len(), bytes.len());
    let reused = request(&server, "POST", &named, &protobuf, &other);
    assert_eq!((reused.code, reused.refusal().0.as_str()), (409, "UPLOAD_ID_REUSED"), "{}", reused.text());
    let mut other = tracks();
    other["xs"][0] = json!(other["xs"][0].as_f64().expect("a number") + 1.0);
    let named = "/v1/tenants/-/inputs?uploadId=0195fa4c-0000-7000-8000-000000000001";
    let reused = post(&server, named, &json!({"trackSet": other}));
    assert_eq!((reused.code, reused.refusal().0.as_str()), (409, "UPLOAD_ID_REUSED"), "{}", reused.text());
    assert_eq!(post(&server, named, &json!({"trackSet": tracks()})).json(), by_json.json());
    let damaged = request(&server, "POST", "/v1/tenants/-/inputs", &protobuf, &bytes[1..]);
    assert_eq!((damaged.code, damaged.refusal().1.as_str()), (400, "data"));
    // The same numbers to the last bit, also those that decimals of 16 and 17 digits stand for.
    let mut set = track_set();
    set.xs.iter_mut().enumerate().for_each(|(k, x)| *x = 1_206.941_123_647_384_5 + 0.1 * k as f64);
    let mut as_json = tracks();
    (as_json["xs"], as_json["views"]) = (json!(set.xs), json!([{}, {}, {}]));
    let bytes = proto::InputData { data: Some(proto::input_data::Data::TrackSet(set)) }.encode_to_vec();
    let digest = |answer: Answer| (answer.json()["sha256"].clone(), path_of(&answer.json()));
    let (exact, first) = digest(request(&server, "POST", "/v1/tenants/-/inputs", &protobuf, &bytes));
    let (read, second) = digest(post(&server, "/v1/tenants/-/inputs", &json!({"trackSet": as_json})));
    assert_eq!(read, exact);
    for path in [first, second] {
        assert_eq!(request(&server, "DELETE", &path, &[], &[]).code, 200);
    }
    let inputs = get(&server, "/v1/tenants/-/inputs").json();
    assert_eq!(inputs["inputs"].as_array().map(Vec::len), Some(2));
    // However an input comes, its job's result has the same digest; another input has another.
    let digest_of = |source: Value| {
        let job = post(&server, "/v1/tenants/-/jobs", &source).json();
        get(&server, &format!("{}/events", path_of(&job)));
        get(&server, &format!("{}/result", path_of(&job))).json()["inputContentSha256"]
            .as_str()
            .expect("a digest")
            .to_owned()
    };
    let unnamed = |mut set: Value| {
        set["views"] = json!([{}, {}, {}]);
        set
    };
    let uploaded = digest_of(json!({"input": by_protobuf.json()["name"]}));
    assert_eq!(uploaded, digest_of(json!({"trackSet": unnamed(tracks())})));
    let named = digest_of(json!({"trackSet": tracks()}));
    assert_eq!(named, digest_of(json!({"input": by_json.json()["name"]})));
    assert_ne!(named, uploaded, "names and sizes count");
    for input in [by_json.json(), by_protobuf.json()] {
        let job = post(&server, "/v1/tenants/-/jobs", &json!({"input": input["name"]})).json();
        let events = get(&server, &format!("{}/events", path_of(&job))).text();
        assert!(events.contains("JOB_STATE_SUCCEEDED"), "{events}");
        assert_eq!(request(&server, "DELETE", &path_of(&input), &[], &[]).code, 200);
    }
}

#[test]
fn a_result_of_any_size_is_read_as_protobuf_and_goes_on_where_it_broke_off() {
    let data = tempfile::tempdir().expect("a temporary directory");
    let server = Serving::start_with(data.path(), &[("SCPSFM_SERVER__MAX_MESSAGE_BYTES", "1049600")], Stdio::null());
    // Tracks without observations: a small input with a large result.
    let mut many = tracks();
    many["trackCount"] = json!(300_000);
    let job = post(&server, "/v1/tenants/-/jobs", &json!({"trackSet": many})).json();
    get(&server, &format!("{}/events", path_of(&job)));
    let path = format!("{}/result", path_of(&job));
    assert_eq!(get(&server, &path).refusal().0, "RESULT_TOO_LARGE");
    let protobuf = ("accept", "application/json;q=0.5, Application/X-Protobuf");
    let read = |verb: &str, more: &[(&str, &str)]| request(&server, verb, &path, &[&[protobuf], more].concat(), &[]);
    let whole = read("GET", &[]);
    assert_eq!((whole.code, whole.header("content-type").as_str()), (200, "application/x-protobuf"));
    assert!(whole.body.len() > 1 << 20, "{} bytes", whole.body.len());
    assert_eq!(whole.header("content-length"), whole.body.len().to_string());
    let result = proto::JobResult::decode(whole.body.as_slice()).expect("a JobResult");
    assert_eq!(
        (result.job.as_str(), result.tracks.expect("tracks").weights.len()),
        (&path[4..path.len() - 7], 300_000)
    );
    // From the middle, if it is the same result still; other ranges are the whole; from the end on nothing.
    let rest = read("GET", &[("range", "bytes=300001-")]);
    assert_eq!((rest.code, rest.header("etag")), (206, whole.header("etag")));
    let length = whole.body.len();
    assert_eq!(rest.header("content-range"), format!("bytes 300001-{}/{length}", length - 1));
    assert!(rest.body == whole.body[300_001..]);
    let range = ("range", "bytes=300001-");
    assert_eq!(read("GET", &[range, ("if-range", &whole.header("etag"))]).code, 206);
    let changed = read("GET", &[range, ("if-range", "\"another\"")]);
    assert!((changed.code, &changed.body) == (200, &whole.body));
    for other in ["bytes=0-99,200-", "bytes=-5", "bytes=+5-", "rows=5-"] {
        assert_eq!(read("GET", &[("range", other)]).code, 200, "{other}");
    }
    let nothing = read("GET", &[("range", &format!("bytes={length}-"))]);
    assert_eq!((nothing.code, nothing.refusal().0.as_str()), (416, "RANGE_NOT_SATISFIABLE"));
    assert_eq!(nothing.header("content-range"), format!("bytes */{length}"));
    let beyond = read("GET", &[("range", &format!("bytes={}-", length + 1))]);
    assert_eq!((beyond.code, beyond.refusal().0.as_str()), (416, "RANGE_NOT_SATISFIABLE"));
    let head = read("HEAD", &[range]);
    assert_eq!((head.code, head.body.len(), head.header("content-length")), (200, 0, whole.header("content-length")));
    let none = request(&server, "GET", "/v1/tenants/-/jobs/none/result", &[protobuf], &[]);
    assert_eq!((none.code, none.refusal().0.as_str()), (404, "JOB_NOT_FOUND"));
    let unacceptable = ("accept", "application/x-protobuf;q=0, application/json");
    assert_eq!(request(&server, "GET", &path, &[unacceptable], &[]).refusal().0, "RESULT_TOO_LARGE");
    let with_a_query = request(&server, "GET", &format!("{path}?offset=5"), &[protobuf], &[]);
    assert_eq!((with_a_query.code, with_a_query.refusal().1.as_str()), (400, "offset"));
    assert_eq!(request(&server, "POST", &path, &[protobuf], &[]).code, 405);
    let nobodys = request(&server, "GET", "/v1/tenants//jobs/x/result", &[protobuf], &[]);
    assert_eq!(nobodys.refusal().0, "PATH_NOT_FOUND");
}

#[test]
fn a_key_is_asked_for_and_says_whose_jobs_are_seen() {
    let data = tempfile::tempdir().expect("a temporary directory");
    let keys = format!("north:{NORTH},south:{SOUTH}");
    let server = Serving::start_with(data.path(), &[("SCPSFM_AUTH__KEYS", &keys)], std::process::Stdio::null());
    let body = json!({"trackSet": tracks()}).to_string();
    let create = |key: Option<&str>| {
        let bearer = key.map(|key| format!("Bearer {key}"));
        let mut headers = vec![("content-type", "application/json")];
        headers.extend(bearer.as_deref().map(|bearer| ("authorization", bearer)));
        request(&server, "POST", "/v1/tenants/-/jobs", &headers, body.as_bytes())
    };
    for (key, reason) in [(None, "API_KEY_MISSING"), (Some("wrong"), "API_KEY_UNKNOWN")] {
        let refused = create(key);
        assert_eq!((refused.code, refused.refusal().0.as_str()), (401, reason));
        assert!(refused.has("www-authenticate: bearer"), "{}", refused.head);
    }
    assert_eq!(refused(&server, "UNAUTHENTICATED"), 2.0);
    let job = create(Some(NORTH)).json();
    assert!(job["name"].as_str().is_some_and(|name| name.starts_with("tenants/north/jobs/")), "{job}");
    let read = |key: &str| {
        let bearer = format!("Bearer {key}");
        request(&server, "GET", &path_of(&job), &[("authorization", &bearer)], &[]).code
    };
    assert_eq!((read(NORTH), read(SOUTH)), (200, 404));
    let path = format!("{}/result", path_of(&job));
    for (key, code) in [("wrong", 401), (SOUTH, 404)] {
        let headers = [("authorization", format!("Bearer {key}")), ("accept", "application/x-protobuf".to_owned())];
        let headers = headers.each_ref().map(|(name, value)| (*name, value.as_str()));
        assert_eq!(request(&server, "GET", &path, &headers, &[]).code, code, "{key}");
    }
}

#[test]
fn a_key_allows_what_its_scope_does() {
    let data = tempfile::tempdir().expect("a temporary directory");
    let keys = format!("north:read-only:{NORTH},south:{SOUTH},ops:admin:{OPS}");
    let server = Serving::start_with(data.path(), &[("SCPSFM_AUTH__KEYS", &keys)], std::process::Stdio::null());
    let ask = |key: &str, verb: &str, path: &str, body: &Value| {
        let headers = [("content-type", "application/json"), ("authorization", &format!("Bearer {key}"))];
        let body = if verb == "GET" { String::new() } else { body.to_string() };
        request(&server, verb, path, &headers, body.as_bytes())
    };
    let refused = |answer: Answer, scope: &str| {
        assert_eq!((answer.code, answer.refusal().0.as_str()), (403, "SCOPE"), "{}", answer.text());
        assert_eq!(answer.json()["error"]["details"][0]["metadata"]["scope"], scope, "{}", answer.text());
    };
    let job = json!({"trackSet": tracks()});
    refused(ask(NORTH, "POST", "/v1/tenants/-/jobs", &job), "ordinary");
    refused(ask(NORTH, "POST", "/v1/tenants/-/inputs", &job), "ordinary");
    refused(ask(NORTH, "GET", "/v1/queue", &json!({})), "admin");
    assert_eq!(ask(NORTH, "GET", "/v1/tenants/-/jobs", &json!({})).code, 200);
    let created = ask(SOUTH, "POST", "/v1/tenants/-/jobs", &job);
    assert_eq!(created.code, 200, "{}", created.text());
    refused(ask(SOUTH, "POST", "/v1/queue:pause", &json!({})), "admin");
    let paused = ask(OPS, "POST", "/v1/queue:pause", &json!({})).json();
    assert!(paused["paused"] == true && paused["pauseTime"].is_string(), "{paused}");
    assert_eq!(paused["jobCounts"].as_array().map(Vec::len), Some(6), "{paused}");
    assert_eq!(ask(OPS, "POST", "/v1/queue:resume", &json!({})).json()["pauseTime"], Value::Null);
    assert_eq!(ask(OPS, "GET", &path_of(&created.json()), &json!({})).code, 200, "of every tenant");
}

#[test]
fn the_description_names_what_is_served_and_every_schema_that_it_refers_to() {
    let (_data, server) = serving();
    let document = get(&server, "/openapi.json").json();
    assert_eq!(document["openapi"], "3.1.0");
    let mut operations = 0;
    for (path, verbs) in document["paths"].as_object().expect("paths") {
        for verb in verbs.as_object().expect("verbs").keys() {
            operations += 1;
            // It would end the server.
            if path == "/v1/server:drain" {
                continue;
            }
            let path = path.replace("{tenant}", "default").replace("{job}", "none").replace("{input}", "none");
            let path = path.replace("{upload_id}", "0195fa4c-0000-7000-8000-000000000001");
            let answer = request(&server, &verb.to_ascii_uppercase(), &path, &[], &[]);
            assert!(
                ![404, 405, 501].contains(&answer.code) || answer.refusal().0.ends_with("_NOT_FOUND"),
                "{verb} {path}"
            );
            assert_ne!(answer.code, 405, "{verb} {path}");
            if answer.code == 404 {
                assert_ne!(answer.refusal().0, "PATH_NOT_FOUND", "{verb} {path}");
            }
        }
    }
    assert_eq!(operations, 19, "every method that the proto annotates, and the upload");
    let text = document.to_string();
    let schemas = document["components"]["schemas"].as_object().expect("schemas");
    for reference in text.split("#/components/schemas/").skip(1) {
        let name = reference.split('"').next().expect("a name");
        assert!(schemas.contains_key(name), "{name}");
    }
    assert_eq!(schemas["TrackSet"]["properties"]["xs"]["type"], "array");
    assert!(
        schemas["TrackSet"]["properties"]["xs"]["description"].as_str().is_some_and(|words| words.contains("pixels"))
    );
}
