//! Damaged messages through the decoders and the checks that every call goes through, in process.

use prost::Message;
use scpsfm::domain::{Input, InvalidInput, Limits};
use scpsfm::rpc::convert::{create, input::Draft, list, names, upload};
use scpsfm::rpc::proto;
use scpsfm::rpc::proto::create_job_request::Source as Inline;
use scpsfm::rpc::proto::input_data::Data;

use crate::support::memory::peak_mb;
use crate::support::mutation;
use crate::support::uploads::encoded;
use crate::support::wire::{create as create_request, create_tracks, match_set, matrix, raw};

/// Tight enough that damaged counts go beyond them.
fn limits() -> Limits {
    Limits { max_views: 8, max_tracks: 64, max_observations: 256 }
}

/// What a case came to.
enum Outcome {
    /// No message at all.
    Undecoded,
    Refused(InvalidInput),
    Accepted(Option<Input>),
}

impl From<Result<Option<Input>, InvalidInput>> for Outcome {
    fn from(checked: Result<Option<Input>, InvalidInput>) -> Self {
        checked.map_or_else(Outcome::Refused, Outcome::Accepted)
    }
}

/// As the service takes a creation.
fn creation(bytes: &[u8]) -> Outcome {
    let Ok(request) = proto::CreateJobRequest::decode(bytes) else { return Outcome::Undecoded };
    let checked = || {
        names::tenant(&request.parent, "default")?;
        create::from_wire(request.job_id, request.request_id, request.job)?;
        let data = match request.source {
            Some(Inline::Input(name)) => {
                names::input(&name, "input", "default")?;
                return Ok(None);
            }
            Some(Inline::TrackSet(set)) => Some(Data::TrackSet(set)),
            Some(Inline::MeasurementMatrix(matrix)) => Some(Data::MeasurementMatrix(matrix)),
            Some(Inline::MatchSet(set)) => Some(Data::MatchSet(set)),
            None => None,
        };
        let draft = Draft::begin(data, &limits())?;
        draft.check_size()?;
        draft.finish().map(Some)
    };
    checked().into()
}

/// As the service takes an upload.
fn uploaded(bytes: &[u8]) -> Outcome {
    upload::read(&mut { bytes }, &limits()).and_then(Draft::finish).map(Some).into()
}

/// As the service takes a page's query.
fn listing(bytes: &[u8]) -> Outcome {
    let Ok(request) = proto::ListJobsRequest::decode(bytes) else { return Outcome::Undecoded };
    let checked = names::tenant(&request.parent, "default").and_then(|tenant| list::from_wire(tenant, request));
    checked.map(|_| None).into()
}

/// As the service takes a job's name.
fn name(bytes: &[u8]) -> Outcome {
    let Ok(request) = proto::GetJobRequest::decode(bytes) else { return Outcome::Undecoded };
    names::job(&request.name, "default").map(|_| None).into()
}

/// A decoder with its checks, and good messages for it.
type Reader = (fn(&[u8]) -> Outcome, Vec<Vec<u8>>);

fn readers() -> [Reader; 4] {
    let mut described = create_tracks();
    described.job_id = "a".into();
    described.request_id = "r".into();
    described.job = Some(proto::Job {
        labels: [("k".to_owned(), "v".to_owned())].into(),
        priority: 7,
        deadline: Some(proto::job::Deadline::TimeLimit(prost_types::Duration { seconds: 9, nanos: 5 })),
        settings: Some(proto::SolveSettings { alpha: Some(0.1), iterations: Some(50), ..Default::default() }),
        ..Default::default()
    });
    let with_matrix = create_request(Inline::MeasurementMatrix(matrix()));
    let with_matches = create_request(Inline::MatchSet(match_set()));
    let with_name = create_request(Inline::Input("tenants/default/inputs/a".into()));
    let uploads = [
        encoded(&raw(3, 4)),
        proto::InputData { data: Some(proto::input_data::Data::MeasurementMatrix(matrix())) }.encode_to_vec(),
        proto::InputData { data: Some(proto::input_data::Data::MatchSet(match_set())) }.encode_to_vec(),
    ];
    let query = proto::ListJobsRequest {
        parent: "tenants/default".into(),
        page_size: 10,
        page_token: "cafe".into(),
        filter: "state = RUNNING OR state = QUEUED AND labels.k = \"v\"".into(),
        order_by: "create_time desc".into(),
    };
    let get = proto::GetJobRequest { name: "tenants/default/jobs/a-b".into() };
    [
        (creation, [described, with_matrix, with_matches, with_name].map(|request| request.encode_to_vec()).to_vec()),
        (uploaded, uploads.to_vec()),
        (listing, vec![query.encode_to_vec()]),
        (name, vec![get.encode_to_vec()]),
    ]
}

/// Runs so many cases: each ends with an answer, what is accepted is within the limits, what is refused is told why.
fn survives(cases: u64) {
    let readers = readers();
    let (mut undecoded, mut refused, mut accepted) = (0_u64, 0_u64, 0_u64);
    for (read, seeds) in &readers {
        for seed in seeds {
            assert!(matches!(read(seed), Outcome::Accepted(_)), "a good message");
        }
    }
    for number in 0..cases {
        let (read, seeds) = &readers[(number % readers.len() as u64) as usize];
        let bytes = mutation::case(seeds, number);
        match std::panic::catch_unwind(|| read(&bytes)) {
            Err(_) => panic!("case {number} of the decoders panicked"),
            Ok(Outcome::Undecoded) => undecoded += 1,
            Ok(Outcome::Refused(error)) => {
                refused += 1;
                let told = error.violations();
                assert!(!told.is_empty() && told.iter().all(|it| !it.to_string().is_empty()), "case {number}");
                assert!(told.len() <= 100, "case {number}: {} violations", told.len());
            }
            Ok(Outcome::Accepted(input)) => {
                accepted += 1;
                let Some(input) = input else { continue };
                let limits = limits();
                let sizes = [input.view_count(), input.track_count(), input.observation_count()];
                let most = [limits.max_views, limits.max_tracks, limits.max_observations];
                assert!(sizes.iter().zip(most).all(|(&size, most)| size <= most), "case {number}: {sizes:?}");
                let finite = |k| input.point_px(k).iter().all(|value: &f64| value.is_finite());
                assert!((0..input.observation_count()).all(finite), "case {number}");
            }
        }
    }
    println!("{cases} cases: {undecoded} were no message, {refused} refused, {accepted} accepted");
    // Else the mutations test one of the three only.
    assert!([undecoded, refused, accepted].iter().all(|&count| count > cases / 100));
}

#[test]
fn thousands_of_damaged_messages_are_refused_or_valid() {
    survives(20_000);
}

#[test]
#[ignore = "a million cases: cargo test --test it decoder -- --ignored"]
fn a_million_damaged_messages_are_refused_or_valid() {
    survives(1_000_000);
    // Run as its comment says, this process has done nothing else: what it holds at once is a message's worth.
    let peak = peak_mb(std::process::id());
    assert!(peak < 200, "{peak} MB");
}
