//! Uploads: where they go on, who may write, what they become, what is removed.

use super::*;
use crate::domain::{InputName, Oversize, Quota};
use crate::store::record::JobInput;
use crate::store::upload::{BegunUpload, NewInput, NewUpload, PurgedUploads, StoredInput, UploadLease};
use crate::store::{InputQuery, Page, UploadBounds};

pub(in crate::store) const ROOMY: UploadBounds =
    UploadBounds { max_bytes: u64::MAX, max_tenant_uploads: u64::MAX, max_tenant_bytes: u64::MAX };

pub(in crate::store) fn name(input: &str) -> InputName {
    InputName { tenant: "t".into(), input: input.into() }
}

pub(in crate::store) fn new(input: &str, bytes: u64) -> NewUpload {
    NewUpload { name: name(input), bytes, sha256: None }
}

async fn begin(store: &Store, new: &NewUpload, seconds: u64) -> (UploadLease, u64) {
    match store.begin_upload(new, &ROOMY, time(seconds)).await.expect("begins") {
        BegunUpload::Open { lease, committed, .. } => (lease, committed),
        BegunUpload::Finished(input) => panic!("{input:?}"),
    }
}

fn input(payload: Vec<u8>) -> Arc<NewInput> {
    NewInput { payload, sha256: [3; 32], view_count: 2, track_count: 5, observation_count: 9 }.into()
}

/// An upload of a few bytes that became an input at that second.
pub(in crate::store) async fn finished(store: &Store, id: &str, payload: Vec<u8>, seconds: u64) -> StoredInput {
    let (lease, _) = begin(store, &new(id, 4), seconds).await;
    store.append_upload(&lease, 0, &[1; 4], time(seconds)).await.expect("appends");
    store.finish_upload(&lease, &input(payload), time(seconds)).await.expect("finishes")
}

pub(in crate::store) async fn jobs_know_their_uploaded_inputs(store: &Store) {
    finished(store, "a", vec![7; 10], 0).await;
    let with = NewRecord { input: JobInput::Uploaded { input: "a".into(), bytes: 10 }, ..record("with") };
    for new in [with, record("without")] {
        store.create_job(new, &ROOM, time(1)).await.expect("created");
    }
    let known = async |job: &str| store.job(&record(job).name).await.expect("kept").input;
    assert_eq!(known("with").await, Some(name("a")));
    assert_eq!(known("without").await, None);
}

async fn whole(store: &Store, lease: &UploadLease) -> Vec<u8> {
    let mut bytes = Vec::new();
    loop {
        let part = store.read_upload(lease, bytes.len() as u64).await.expect("reads");
        assert!(part.len() <= 4 * payload::CHUNK_BYTES, "{} bytes at once", part.len());
        if part.is_empty() {
            return bytes;
        }
        bytes.extend(part);
    }
}

pub(in crate::store) async fn an_upload_goes_on_where_it_ended_and_becomes_an_input(store: &Store) {
    // More than one read brings, and cut where no row ends.
    let bytes: Vec<u8> = (0..6 * payload::CHUNK_BYTES + 17).map(|k| (k % 251) as u8).collect();
    let upload = new("a", bytes.len() as u64);
    assert_eq!(store.upload(&upload.name).await, Err(Error::UploadNotFound(upload.name.clone())));
    let (lease, committed) = begin(store, &upload, 0).await;
    assert_eq!(committed, 0);
    let cut = 2 * payload::CHUNK_BYTES + 5;
    store.append_upload(&lease, 0, &bytes[..cut], time(1)).await.expect("appends");
    let status = store.upload(&upload.name).await.expect("is there");
    assert_eq!((status.bytes, status.committed, status.input), (upload.bytes, cut as u64, None));
    let early = store.finish_upload(&lease, &input(vec![7]), time(1)).await;
    assert!(matches!(early, Err(Error::Corrupt(_))), "{early:?}");

    let (lease, committed) = begin(store, &upload, 2).await;
    assert_eq!(committed, cut as u64);
    store.append_upload(&lease, committed, &bytes[cut..], time(3)).await.expect("appends");
    assert_eq!(whole(store, &lease).await, bytes);
    let beyond = store.append_upload(&lease, upload.bytes, &[1], time(3)).await;
    assert_eq!(beyond, Err(Error::UploadTakenOver(upload.name.clone())));

    assert_eq!(store.uploaded_input(&upload.name).await, Err(Error::InputNotFound(upload.name.clone())));
    let stored = store.finish_upload(&lease, &input(vec![7; 300]), time(4)).await.expect("finishes");
    let expected = StoredInput {
        name: upload.name.clone(),
        create_time: time(4),
        upload_bytes: upload.bytes,
        sha256: [3; 32],
        payload_bytes: 300,
        view_count: 2,
        track_count: 5,
        observation_count: 9,
    };
    assert_eq!(stored, expected);
    assert_eq!(store.uploaded_input(&upload.name).await, Ok(expected.clone()));
    assert_eq!(store.upload(&upload.name).await.expect("is there").input, Some(expected.clone()));
    let again = store.begin_upload(&upload, &ROOMY, time(5)).await;
    assert_eq!(again, Ok(BegunUpload::Finished(expected)));
    let late = store.append_upload(&lease, upload.bytes, &[1], time(5)).await;
    assert_eq!(late, Err(Error::UploadTakenOver(upload.name.clone())));
    let foreign = InputName { tenant: "u".into(), ..upload.name.clone() };
    assert_eq!(store.upload(&foreign).await, Err(Error::UploadNotFound(foreign.clone())));
    assert_eq!(store.uploaded_input(&foreign).await, Err(Error::InputNotFound(foreign)));
}

pub(in crate::store) async fn the_latest_stream_has_the_upload(store: &Store) {
    let upload = new("a", 10);
    let (first, _) = begin(store, &upload, 0).await;
    store.append_upload(&first, 0, &[1; 3], time(0)).await.expect("appends");
    let (second, committed) = begin(store, &upload, 1).await;
    assert_eq!(committed, 3);
    let taken_over = Error::UploadTakenOver(upload.name.clone());
    assert_eq!(store.append_upload(&first, 3, &[1; 3], time(1)).await, Err(taken_over.clone()));
    assert_eq!(store.read_upload(&first, 0).await, Err(taken_over.clone()));
    assert_eq!(store.finish_upload(&first, &input(vec![7]), time(1)).await, Err(taken_over.clone()));
    assert_eq!(store.give_up_upload(&first).await, Err(taken_over));
    store.append_upload(&second, 3, &[2; 7], time(1)).await.expect("appends");
    assert_eq!(whole(store, &second).await, [&[1; 3][..], &[2; 7]].concat());
    store.give_up_upload(&second).await.expect("gives up");
    let gone = Error::UploadNotFound(upload.name.clone());
    assert_eq!(store.append_upload(&second, 10, &[1], time(2)).await, Err(gone.clone()));
    assert_eq!(store.upload(&upload.name).await, Err(gone));
    // The id is free again, and the new upload has nothing of the old one.
    let (third, committed) = begin(store, &new("a", 4), 3).await;
    assert_eq!((committed, third.writer), (0, 1));
    store.append_upload(&third, 0, &[9; 4], time(3)).await.expect("appends");
    store.purge_uploads(None, None).await.expect("removes what was given up");
    assert_eq!(whole(store, &third).await, [9; 4]);
}

pub(in crate::store) async fn an_upload_id_stands_for_one_length_and_hash(store: &Store) {
    let hashed = |bytes, hash: Option<u8>| NewUpload { sha256: hash.map(|byte| [byte; 32]), ..new("a", bytes) };
    begin(store, &hashed(4, None), 0).await;
    begin(store, &hashed(4, Some(3)), 0).await;
    let (lease, _) = begin(store, &hashed(4, None), 0).await;
    store.append_upload(&lease, 0, &[1; 4], time(0)).await.expect("appends");
    for finished in [false, true] {
        if finished {
            store.finish_upload(&lease, &input(vec![7]), time(1)).await.expect("finishes");
        }
        for other in [hashed(5, None), hashed(4, Some(4)), hashed(3, Some(3))] {
            let error = store.begin_upload(&other, &ROOMY, time(2)).await.expect_err("other bytes");
            assert!(matches!(error, Error::AlreadyExists(_)), "{error}");
        }
    }
    let same = store.begin_upload(&hashed(4, Some(3)), &ROOMY, time(2)).await;
    assert!(matches!(same, Ok(BegunUpload::Finished(_))), "{same:?}");
    let mut elsewhere = hashed(5, None);
    elsewhere.name.tenant = "u".into();
    begin(store, &elsewhere, 2).await;
}

pub(in crate::store) async fn a_tenants_uploads_are_bounded(store: &Store) {
    let bounds = UploadBounds { max_tenant_uploads: 2, max_tenant_bytes: 400, ..ROOMY };
    let begin_within = |new: NewUpload| async move { store.begin_upload(&new, &bounds, time(0)).await };
    let refused = async |new: NewUpload| match begin_within(new).await {
        Err(Error::UploadsFull(bound)) => bound,
        other => panic!("{other:?}"),
    };
    let oversize = Oversize { quota: Quota::TenantUploadBytes, asked: 401, max: 400 };
    assert_eq!(begin_within(new("a", 401)).await, Err(Error::UploadTooLarge(oversize)));
    // An input counts with what was uploaded, whatever is stored of it, and is not open any more.
    let done = finished(store, "done", vec![7; 100], 0).await;
    assert_eq!((done.upload_bytes, done.payload_bytes), (4, 100));
    begin_within(new("a", 200)).await.expect("room");
    assert_eq!(
        refused(new("b", 197)).await,
        Bound { quota: Quota::TenantUploadBytes, taken: 204, asked: 197, max: 400 }
    );
    begin_within(new("b", 196)).await.expect("room");
    assert_eq!(refused(new("c", 1)).await, Bound { quota: Quota::TenantUploads, taken: 2, asked: 1, max: 2 });
    begin_within(new("b", 196)).await.expect("one that is open goes on");
    let mut elsewhere = new("c", 400);
    elsewhere.name.tenant = "u".into();
    begin_within(elsewhere).await.expect("another tenant has its own room");
    let (lease, _) = begin(store, &new("a", 200), 1).await;
    store.give_up_upload(&lease).await.expect("gives up");
    begin_within(new("c", 200)).await.expect("what was given up takes no room");
}

pub(in crate::store) async fn what_nobody_goes_on_with_is_given_up_and_removed(store: &Store) {
    let (old, _) = begin(store, &new("old", 1 << 30), 0).await;
    // More rows than one look removes.
    let row = vec![5; payload::CHUNK_BYTES];
    let many = row.repeat(130);
    store.append_upload(&old, 0, &many, time(10)).await.expect("appends");
    let (young, _) = begin(store, &new("young", 10), 0).await;
    store.append_upload(&young, 0, &[1; 5], time(20)).await.expect("appends");
    let none = PurgedUploads::default();
    assert_eq!(store.purge_uploads(None, None).await, Ok(none));
    assert_eq!(store.purge_uploads(Some(time(9)), None).await, Ok(none));
    assert_eq!(store.purge_uploads(Some(time(10)), None).await, Ok(PurgedUploads { abandoned: 1, inputs: 0 }));
    assert_eq!(store.upload(&name("old")).await, Err(Error::UploadNotFound(name("old"))));
    assert_eq!(
        store.append_upload(&old, many.len() as u64, &row, time(20)).await,
        Err(Error::UploadNotFound(name("old")))
    );
    for _ in 0..3 {
        assert_eq!(store.purge_uploads(Some(time(10)), None).await, Ok(none));
    }
    assert_eq!(store.upload(&name("young")).await.expect("stays").committed, 5);
    store.append_upload(&young, 5, &[2; 5], time(30)).await.expect("goes on");
    assert_eq!(whole(store, &young).await, [&[1; 5][..], &[2; 5]].concat());
    store.reclaim().await.expect("gives back");
}

pub(in crate::store) async fn an_input_lives_as_long_as_a_job_has_it(store: &Store) {
    let payload = vec![7; payload::CHUNK_BYTES + 3];
    finished(store, "used", payload.clone(), 0).await;
    finished(store, "unused", vec![8; 10], 0).await;
    let of = |job: &str, input: &str| NewRecord {
        input: JobInput::Uploaded { input: input.into(), bytes: 50 },
        ..record(job)
    };
    let job = create(store, of("a", "used"), 5).await;
    assert_eq!(job.input, Some(name("used")));
    create(store, of("b", "used"), 5).await;
    assert_eq!(store.job_payload(&job.name, u32::MAX).await.map(|payload| payload.input), Ok(payload.clone()));
    assert_eq!(store.queue_stats().await.expect("counts").queued_bytes, 100);
    let missing = store.create_job(of("c", "none"), &ROOM, time(5)).await;
    assert_eq!(missing.expect_err("no such input"), Error::InputNotFound(name("none")));
    let mut foreign = of("c", "used");
    foreign.name.tenant = "u".into();
    let theirs = store.create_job(foreign, &ROOM, time(5)).await;
    assert!(matches!(theirs, Err(Error::InputNotFound(_))), "another tenant's");
    assert!(matches!(store.job(&record("c").name).await, Err(Error::NotFound(_))), "nothing was stored");
    // A repeated request neither needs the input again nor takes it away.
    let request = Some(Request { id: "r".into(), digest: [1; 32] });
    let repeated = || NewRecord { request: request.clone(), ..of("d", "used") };
    assert!(store.create_job(repeated(), &ROOM, time(5)).await.expect("created").by_this_call);
    assert!(!store.create_job(repeated(), &ROOM, time(5)).await.expect("known").by_this_call);
    assert!(store.uploaded_input(&name("used")).await.is_ok());

    assert_eq!(store.purge_uploads(None, Some(time(100))).await, Ok(PurgedUploads { abandoned: 0, inputs: 1 }));
    assert_eq!(store.uploaded_input(&name("unused")).await, Err(Error::InputNotFound(name("unused"))));
    assert_eq!(store.upload(&name("unused")).await, Err(Error::UploadNotFound(name("unused"))));
    for job in ["a", "b", "d"] {
        let job = record(job).name;
        assert_eq!(store.job_payload(&job, u32::MAX).await.map(|payload| payload.input), Ok(payload.clone()));
        store.request_cancel(&job, None, time(6)).await.expect("ends");
        store.delete_job(&job, None).await.expect("deletes");
    }
    assert!(store.uploaded_input(&name("used")).await.is_ok(), "it has a life of its own");
    assert_eq!(store.purge_uploads(None, Some(time(4))).await, Ok(PurgedUploads::default()), "used since");
    assert_eq!(store.purge_uploads(None, Some(time(5))).await, Ok(PurgedUploads { abandoned: 0, inputs: 1 }));
    assert!(store.uploaded_input(&name("used")).await.is_err());
}

pub(in crate::store) async fn a_finished_upload_that_is_begun_again_is_kept_as_one_that_is_used(store: &Store) {
    for input in ["asked", "forgotten"] {
        finished(store, input, vec![7; 10], 0).await;
    }
    let again = store.begin_upload(&new("asked", 4), &ROOMY, time(50)).await.expect("is known");
    assert!(matches!(again, BegunUpload::Finished(_)), "{again:?}");
    assert_eq!(store.purge_uploads(None, Some(time(49))).await, Ok(PurgedUploads { abandoned: 0, inputs: 1 }));
    assert!(store.uploaded_input(&name("forgotten")).await.is_err());
    assert!(store.uploaded_input(&name("asked")).await.is_ok());
    assert_eq!(store.purge_uploads(None, Some(time(50))).await, Ok(PurgedUploads { abandoned: 0, inputs: 1 }));
}

pub(in crate::store) async fn inputs_are_listed_page_by_page(store: &Store) {
    for (input, seconds) in [("a", 3), ("b", 1), ("c", 3), ("d", 2)] {
        finished(store, input, vec![7; 10], seconds).await;
    }
    begin(store, &new("open", 10), 9).await;
    create(store, record("of-a-job-alone"), 9).await;
    let page = async |tenant: &str, page_size, page_token: Option<String>| {
        store.inputs(&InputQuery { tenant: tenant.into(), page_size, page_token }).await
    };
    let ids = |page: &Page<StoredInput>| page.items.iter().map(|input| input.name.input.clone()).collect::<Vec<_>>();
    let whole = page("t", 0, None).await.expect("a page");
    assert_eq!((ids(&whole), &whole.next_page_token), (["c", "a", "d", "b"].map(str::to_owned).to_vec(), &None));
    assert_eq!(whole.items[3], store.uploaded_input(&name("b")).await.expect("is there"));
    let first = page("t", 3, None).await.expect("a page");
    assert_eq!(ids(&first), ["c", "a", "d"]);
    let token = first.next_page_token.clone();
    let second = page("t", 3, token.clone()).await.expect("a page");
    assert_eq!((ids(&second), second.next_page_token), (vec!["b".to_owned()], None));
    assert_eq!(page("u", 0, None).await, Ok(Page { items: Vec::new(), next_page_token: None }));
    assert_eq!(page("u", 3, token.clone()).await, Err(Error::PageToken));
    let of_jobs = JobQuery { tenant: "t".into(), page_token: token, ..JobQuery::default() };
    assert_eq!(store.jobs(&of_jobs).await, Err(Error::PageToken), "a token of inputs is none of jobs");
}

pub(in crate::store) async fn a_deleted_input_is_kept_by_its_jobs_alone(store: &Store) {
    let payload = vec![7; payload::CHUNK_BYTES + 3];
    for input in ["shared", "free"] {
        finished(store, input, payload.clone(), 0).await;
    }
    let of = |job: &str| NewRecord { input: JobInput::Uploaded { input: "shared".into(), bytes: 50 }, ..record(job) };
    let (a, b) = (create(store, of("a"), 1).await.name, create(store, of("b"), 1).await.name);
    let foreign = InputName { tenant: "u".into(), input: "shared".into() };
    assert_eq!(store.delete_input(&foreign).await, Err(Error::InputNotFound(foreign.clone())));
    for input in ["shared", "free"] {
        store.delete_input(&name(input)).await.expect("deletes");
        assert_eq!(store.delete_input(&name(input)).await, Err(Error::InputNotFound(name(input))));
        assert_eq!(store.uploaded_input(&name(input)).await, Err(Error::InputNotFound(name(input))));
        assert_eq!(store.upload(&name(input)).await, Err(Error::UploadNotFound(name(input))));
    }
    for job in [&a, &b] {
        let input = store.job(job).await.expect("is there").input;
        assert_eq!(input, Some(name("shared")), "what it was created with, though that has no name any more");
    }
    let late = store.create_job(of("c"), &ROOM, time(2)).await;
    assert_eq!(late.expect_err("its name is gone"), Error::InputNotFound(name("shared")));
    // Its id is free for other bytes; the old ones count against the tenant while jobs have them, and once they are
    // cleared away the free one's do not.
    for _ in 0..3 {
        store.purge_uploads(None, None).await.expect("clears away");
    }
    let taken = 4;
    let tight = UploadBounds { max_tenant_uploads: 1, max_tenant_bytes: taken + 3, ..ROOMY };
    let refused = store.begin_upload(&new("shared", 4), &tight, time(3)).await;
    let bound = Bound { quota: Quota::TenantUploadBytes, taken, asked: 4, max: taken + 3 };
    assert_eq!(refused, Err(Error::UploadsFull(bound)));
    let bounds = UploadBounds { max_tenant_uploads: 1, max_tenant_bytes: taken + 4, ..ROOMY };
    let again = store.begin_upload(&new("shared", 4), &bounds, time(3)).await.expect("room");
    let BegunUpload::Open { lease, committed: 0, .. } = again else { panic!("{again:?}") };
    store.append_upload(&lease, 0, &[1; 4], time(3)).await.expect("appends");
    store.finish_upload(&lease, &input(vec![9; 10]), time(3)).await.expect("finishes");
    // Each job has the old bytes to its end, also once the other is gone.
    for (job, other) in [(&a, Some(&b)), (&b, None)] {
        assert_eq!(store.job_payload(job, u32::MAX).await.map(|payload| payload.input), Ok(payload.clone()));
        store.request_cancel(job, None, time(4)).await.expect("ends");
        store.delete_job(job, None).await.expect("deletes");
        if let Some(other) = other {
            assert_eq!(store.job_payload(other, u32::MAX).await.map(|payload| payload.input), Ok(payload.clone()));
        }
    }
    assert!(store.uploaded_input(&name("shared")).await.is_ok(), "the new one has nothing to do with them");
    let bounds = UploadBounds { max_tenant_uploads: 1, max_tenant_bytes: 4 + 4, ..ROOMY };
    let room = store.begin_upload(&new("next", 4), &bounds, time(5)).await;
    let Ok(BegunUpload::Open { lease, .. }) = room else { panic!("only the new one counts: {room:?}") };
    store.give_up_upload(&lease).await.expect("gives up");
}

/// Looks at an upload whose input is made and deleted meanwhile.
pub(in crate::store) async fn a_status_beside_deletions_is_whole_or_none(store: &Store) {
    const ROUNDS: usize = 100;
    let upload = name("a");
    let churn = async {
        for _ in 0..ROUNDS {
            finished(store, "a", vec![7; 10], 0).await;
            store.delete_input(&upload).await.expect("is there");
        }
    };
    let looks = async {
        loop {
            match store.upload(&upload).await {
                Ok(_) | Err(Error::UploadNotFound(_)) => {}
                Err(other) => panic!("{other:?}"),
            }
        }
    };
    tokio::select! {
        () = churn => {}
        () = looks => {}
    }
}

pub(in crate::store) async fn many_that_begin_at_once_share_the_last_room(store: &Store) {
    let bounds = UploadBounds { max_tenant_uploads: 3, ..ROOMY };
    let uploads: Vec<_> = (0..24).map(|number| new(&format!("upload-{}", number % 12), 10)).collect();
    let begun = uploads.iter().map(|upload| store.begin_upload(upload, &bounds, time(0)));
    let begun = futures_util::future::join_all(begun).await;
    let mut open: Vec<UploadLease> = Vec::new();
    for outcome in begun {
        match outcome {
            Ok(BegunUpload::Open { lease, .. }) => open.push(lease),
            Err(Error::UploadsFull(Bound { quota: Quota::TenantUploads, taken: 3, asked: 1, max: 3 })) => {}
            other => panic!("{other:?}"),
        }
    }
    let mut names: Vec<_> = open.iter().map(|lease| lease.name.input.clone()).collect();
    names.sort();
    names.dedup();
    assert_eq!(names.len(), 3, "{open:?}");
    // Of two streams of one upload, one may write.
    for name in names {
        let mut writes = 0;
        for lease in open.iter().filter(|lease| lease.name.input == name) {
            writes += usize::from(store.append_upload(lease, 0, &[1], time(1)).await.is_ok());
        }
        assert_eq!(writes, 1, "{name}");
    }
}
