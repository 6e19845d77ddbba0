//! Keypoints and matches as an input: what the server joins is what the command line joins, by every way in.

use std::path::{Path, PathBuf};

use scpsfm::rpc::convert::input_message::InputMessage;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, create_job_request::Source, solve_request::Message};
use serde_json::Value;
use tonic::transport::Channel;

use crate::support::live::{created, reaches};
use crate::support::program::{Run, Serving, run};
use crate::support::server::{TestServer, soon};
use crate::support::solvers::quick;
use crate::support::uploads::{DEFAULT, id, whole};
use crate::support::wire::{all, create, match_set, solve_request};

/// What is used of COLMAP's schema.
const SCHEMA: &str = "
    CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY, model INTEGER NOT NULL, width INTEGER NOT NULL,
        height INTEGER NOT NULL, params BLOB, prior_focal_length INTEGER NOT NULL);
    CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, camera_id INTEGER NOT NULL);
    CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB);
    CREATE TABLE matches (pair_id INTEGER PRIMARY KEY, rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB);
    CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER NOT NULL, cols INTEGER NOT NULL,
        data BLOB, config INTEGER NOT NULL);";

/// COLMAP's numbering of pairs.
const MAX_IMAGES: i64 = 2_147_483_647;

const VIEWS: usize = 6;

fn text(path: &Path) -> &str {
    path.to_str().expect("a path of ours")
}

/// A scene with 30 right tracks of 60 as a database of raw matches between all images, names in descending order. Each
/// image has a keypoint without a match, and one match is wrong.
fn database(directory: &Path) -> PathBuf {
    let scene = directory.join("scene");
    let made =
        run(["synth", "--views", "6", "--tracks", "60", "--outliers", "0.5", "--seed", "5", "--out", text(&scene)]);
    assert_eq!(made.code, Some(0), "{made:?}");
    let table = std::fs::read_to_string(scene.join("observations.csv")).expect("the scene");
    // Track and place of every keypoint of each image; track 99 is none.
    let mut seen = vec![vec![(99, [3.0_f32, 4.0])]; VIEWS];
    for line in table.lines().skip(1) {
        let fields: Vec<f64> = line.split(',').map(|field| field.parse().expect("a number")).collect();
        seen[fields[0] as usize].push((fields[1] as u32, [fields[2] as f32 + 0.5, fields[3] as f32 + 0.5]));
    }
    let path = directory.join("database.db");
    let database = rusqlite::Connection::open(&path).expect("a database");
    database.execute_batch(SCHEMA).expect("the schema");
    let params: Vec<u8> = [900.0, 500.0, 500.0, 0.0_f64].into_iter().flat_map(f64::to_le_bytes).collect();
    database.execute("INSERT INTO cameras VALUES (1, 2, 1000, 1000, ?, 0)", [params]).expect("a camera");
    for (view, keypoints) in seen.iter().enumerate() {
        let image = (view + 1) as i64;
        let name = format!("{}.jpg", VIEWS - view);
        database.execute("INSERT INTO images VALUES (?, ?, 1)", (image, name)).expect("an image");
        let data: Vec<u8> = keypoints.iter().flat_map(|(_, point)| *point).flat_map(f32::to_le_bytes).collect();
        let row = (image, keypoints.len() as i64, data);
        database.execute("INSERT INTO keypoints VALUES (?, ?, 2, ?)", row).expect("keypoints");
    }
    for first in 0..VIEWS {
        for second in first + 1..VIEWS {
            let place = |view: usize, track: u32| seen[view].iter().position(|&(of, _)| of == track);
            let both = |track: u32| Some([place(first, track)? as u32, place(second, track)? as u32]);
            let mut pairs: Vec<[u32; 2]> = (0..60).filter_map(both).collect();
            if (first, second) == (0, 1) {
                // The first keypoint of one track and the second of another.
                pairs.push([pairs[0][0], pairs[1][1]]);
            }
            let data: Vec<u8> = pairs.iter().flatten().flat_map(|keypoint| keypoint.to_le_bytes()).collect();
            let row = ((first + 1) as i64 * MAX_IMAGES + (second + 1) as i64, pairs.len() as i64, data);
            database.execute("INSERT INTO matches VALUES (?, ?, 2, ?)", row).expect("matches");
        }
    }
    database.close().expect("closed");
    path
}

/// Runs to a good end.
fn good(arguments: &[&str]) -> Run {
    let run = run(arguments);
    assert_eq!(run.code, Some(0), "{arguments:?}: {run:?}");
    run
}

async fn result_of(jobs: &mut JobServiceClient<Channel>, name: &str) -> proto::JobResult {
    let request = proto::GetJobResultRequest { name: name.to_owned() };
    jobs.get_job_result(request).await.expect("a result").into_inner()
}

/// Solved here, by `solve --server`, by `submit` and by `upload`: the same files, the same tracks.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_database_is_the_same_tracks_here_and_on_a_server() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let path = |name: &str| directory.path().join(name);
    let database = database(directory.path());
    let (local, remote, fetched) = (path("local"), path("remote"), path("fetched"));
    let solve = ["solve", text(&database), "--method", "geometry", "--out"];
    let here = good(&[&solve[..], &[text(&local), "--json"]].concat());
    assert!(here.stderr.contains(" into 60 tracks; cut 1 match, "), "{here:?}");
    let summary: Value = serde_json::from_str(&here.stdout).expect("JSON");
    assert_eq!(summary["registered_views"], 6, "{summary}");

    let serving = Serving::start(&path("data"));
    let server = ["--server", serving.grpc.as_str()];
    good(&[&solve[..], &[text(&remote), "--json"], &server].concat());
    let name = |run: Run| run.stdout.trim().to_owned();
    let submitted = name(good(&[&["submit", text(&database), "--method", "geometry"][..], &server].concat()));
    good(&[&["watch", submitted.as_str()][..], &server].concat());
    let result = ["result", submitted.as_str(), "--input", text(&database), "--out", text(&fetched)];
    good(&[&result[..], &server].concat());
    for file in ["observations.csv", "tracks.csv", "cameras.json"] {
        let content = |side: &Path| std::fs::read_to_string(side.join(file)).expect("a file");
        assert!(content(&local) == content(&remote), "{file} of solve --server differs");
        assert!(content(&local) == content(&fetched), "{file} of submit differs");
    }

    // That it was matches that came, and which keypoint each observation is.
    let mut jobs = JobServiceClient::connect(serving.grpc.clone()).await.expect("a connection");
    let found = result_of(&mut jobs, &submitted).await;
    let joined = found.joined_tracks.clone().expect("joined on the server");
    assert_eq!(joined.cut_match_count, 1);
    let observations = std::fs::read_to_string(local.join("observations.csv")).expect("a file");
    let mut lines = observations.lines();
    let columns: Vec<&str> = lines.next().expect("a header").split(',').collect();
    let column = |name: &str| columns.iter().position(|column| *column == name).expect("a column");
    let told: Vec<(String, u32, u32)> = lines
        .map(|line| {
            let fields: Vec<&str> = line.split(',').collect();
            let number = |name: &str| fields[column(name)].parse().expect("a number");
            (fields[column("view")].to_owned(), number("track"), number("keypoint"))
        })
        .collect();
    let names = |view: u32| found.views[view as usize].name.clone();
    let sent: Vec<(String, u32, u32)> = joined
        .view_indices
        .iter()
        .zip(&joined.track_indices)
        .zip(&joined.keypoint_indices)
        .map(|((&view, &track), &keypoint)| (names(view), track, keypoint))
        .collect();
    assert_eq!(sent, told);

    let uploaded = name(good(&[&["upload", text(&database)][..], &server].concat()));
    let again = ["submit", "--input", uploaded.as_str(), "--method", "geometry"];
    let again = name(good(&[&again[..], &server].concat()));
    good(&[&["watch", again.as_str()][..], &server].concat());
    let again = result_of(&mut jobs, &again).await;
    assert_eq!((again.joined_tracks, again.tracks), (found.joined_tracks, found.tracks));
}

/// In one message, in chunks and uploaded: the same tracks.
#[tokio::test]
async fn matches_are_the_same_tracks_however_they_come() {
    let server = TestServer::start(quick()).await;
    let mut jobs = server.jobs().await;
    let name = created(&mut jobs, create(Source::MatchSet(match_set()))).await;
    assert_eq!(reaches(&mut jobs, &name, &[proto::JobState::Succeeded]).await, proto::JobState::Succeeded);
    let job = jobs.get_job(proto::GetJobRequest { name: name.clone() }).await.expect("the job").into_inner();
    assert_eq!((job.view_count, job.track_count, job.observation_count), (3, 2, 5));
    let joined = result_of(&mut jobs, &name).await.joined_tracks.expect("joined");
    let expected = proto::JoinedTracks {
        view_indices: vec![0, 1, 2, 0, 1],
        track_indices: vec![0, 0, 0, 1, 1],
        keypoint_indices: vec![0, 1, 0, 1, 0],
        match_count: 3,
        cut_match_count: 0,
    };
    assert_eq!(joined, expected);

    let set = match_set();
    let head = Message::Config(create(Source::MatchSet(set.head())));
    let chunks = (0..).map_while(|number| set.chunk(number)).map(Message::MatchSetChunk);
    let messages: Vec<_> = std::iter::once(head).chain(chunks).map(solve_request).collect();
    assert_eq!(messages.len(), 2);
    let answer = server.calibration().await.solve(tokio_stream::iter(messages)).await.expect("a solve");
    let (events, end) = soon(all(answer.into_inner())).await;
    end.expect("ends with the job");
    let solved = result_of(&mut jobs, &events[0].job).await;
    assert_eq!(solved.joined_tracks.as_ref(), Some(&expected));

    let data = proto::input_data::Data::MatchSet(match_set());
    let bytes = prost::Message::encode_to_vec(&proto::InputData { data: Some(data) });
    let mut inputs = proto::input_service_client::InputServiceClient::new(server.channel().await);
    let upload = tokio_stream::iter(whole(DEFAULT, &id(1), &bytes, 10));
    let input = soon(inputs.upload_input(upload)).await.expect("an input").into_inner();
    assert_eq!((input.view_count, input.track_count, input.observation_count), (3, 2, 5));
    let name = created(&mut jobs, create(Source::Input(input.name))).await;
    assert_eq!(reaches(&mut jobs, &name, &[proto::JobState::Succeeded]).await, proto::JobState::Succeeded);
    assert_eq!(result_of(&mut jobs, &name).await.joined_tracks, Some(expected));
}
