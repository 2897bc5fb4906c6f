//! The names of the files of a recording, and the files that are deleted.

use super::*;

fn folder(file: &Path, replaces: bool) -> io::Result<Folder> {
    Folder::open(&Options { file: file.to_owned(), replaces, keep_mb: 1, ..Options::default() })
}

#[test]
fn a_new_run_never_overwrites_an_earlier_recording() {
    let temporary = tempfile::tempdir().unwrap();
    let file = temporary.path().join("car.mcap");
    for expected in ["car.mcap", "car-1.mcap", "car-2.mcap"] {
        let found = next_free_name(&file);
        assert_eq!(found, temporary.path().join(expected));
        File::create(found).unwrap();
    }
    File::create(temporary.path().join("car-3.unfinished.mcap")).unwrap();
    assert_eq!(next_free_name(&file), temporary.path().join("car-4.mcap"));
    // The first parts of a run are deleted before its last parts.
    fs::remove_file(&file).unwrap();
    fs::rename(temporary.path().join("car-1.mcap"), temporary.path().join("car.part-0007.mcap")).unwrap();
    assert_eq!(next_free_name(&file), temporary.path().join("car-1.mcap"));
    assert_eq!(folder(&file, false).unwrap_err().kind(), ErrorKind::AlreadyExists);
    assert_eq!(folder(temporary.path(), false).unwrap_err().kind(), ErrorKind::IsADirectory);
}

#[test]
fn a_part_gets_its_name_when_it_is_closed_and_replaces_no_file() {
    let temporary = tempfile::tempdir().unwrap();
    let at = |name: &str| temporary.path().join(name);
    let mut parts = folder(&at("car.mcap"), false).unwrap();
    drop(parts.create(1).unwrap());
    assert!(at("car.unfinished.mcap").exists() && !at("car.mcap").exists());
    assert_eq!(folder(&at("car.mcap"), false).unwrap_err().kind(), ErrorKind::AlreadyExists);
    // Another program makes a file of that name meanwhile.
    fs::write(at("car.mcap"), "precious").unwrap();
    assert_eq!(parts.complete(1).unwrap_err().kind(), ErrorKind::AlreadyExists);
    assert_eq!(fs::read(at("car.mcap")).unwrap(), b"precious");
    assert!(at("car.unfinished.mcap").exists(), "nothing is lost");
    let mut replacing = folder(&at("car.mcap"), true).unwrap();
    replacing.complete(1).unwrap();
    assert_eq!(fs::read(at("car.mcap")).unwrap(), b"");
}

#[test]
fn old_parts_are_deleted_beyond_the_size_and_saved_ones_stay() {
    let temporary = tempfile::tempdir().unwrap();
    let at = |name: &str| temporary.path().join(name);
    let mut parts = folder(&at("car.mcap"), false).unwrap();
    fs::write(at("car2.mcap"), vec![0; 3 << 20]).unwrap();
    for part in 1..=4 {
        drop(parts.create(part).unwrap());
        fs::write(parts.path(part), vec![0; 400 << 10]).unwrap();
        parts.complete(part).unwrap();
        let time = SystemTime::UNIX_EPOCH + Duration::from_secs(part);
        File::options().write(true).open(parts.finished(part)).unwrap().set_modified(time).unwrap();
    }
    let saved = parts.keep(&[1, 2], "fault").unwrap();
    parts.delete_old();
    let late = parts.keep(&[2, 3], "late").unwrap();
    assert_eq!(late, [at("saved/late/car.part-0003.mcap")], "part 2 is deleted");
    assert!(parts.keep(&[1], "later").unwrap_err().to_string().contains("deleted"));
    // A part that the disk has refused is saved as it is.
    drop(parts.create(5).unwrap());
    assert_eq!(parts.keep(&[5], "refused").unwrap(), [at("saved/refused/car.part-0005.unfinished.mcap")]);
    let left: Vec<bool> = (1..=4).map(|part| parts.finished(part).exists()).collect();
    assert_eq!(left, [false, false, true, true], "two parts of 400 KiB fit into 1 MiB");
    assert!(saved.len() == 2 && saved.iter().all(|link| link.metadata().unwrap().len() == 400 << 10));
    assert!(at("car2.mcap").exists(), "a file of another name is not a part");
}

#[test]
fn the_oldest_saves_are_deleted_beyond_the_configured_length_and_the_newest_stays() {
    let temporary = tempfile::tempdir().unwrap();
    let options = Options { file: temporary.path().join("car.mcap"), saved_mb: 1, ..Options::default() };
    let mut folder = Folder::open(&options).unwrap();
    fs::write(&options.file, vec![0; 400 << 10]).unwrap();
    let saves = || {
        let names = fs::read_dir(temporary.path().join("saved")).unwrap();
        let mut names: Vec<_> = names.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    };
    for name in ["1-a", "2-b", "3-c", "4-d"] {
        folder.keep(&[1], name).unwrap();
    }
    assert_eq!(saves(), ["3-c", "4-d"], "each has 400 KiB");
    fs::write(&options.file, vec![0; 2 << 20]).unwrap();
    folder.keep(&[1], "5-e").unwrap();
    assert_eq!(saves(), ["5-e"], "the newest stays, however long it is");
    assert!(options.file.exists());
}

#[test]
fn a_file_is_the_same_through_every_kind_of_link() {
    let temporary = tempfile::tempdir().unwrap();
    let at = |name: &str| temporary.path().join(name);
    fs::write(at("a"), "").unwrap();
    fs::hard_link(at("a"), at("hard")).unwrap();
    std::os::unix::fs::symlink(at("a"), at("soft")).unwrap();
    fs::write(at("b"), "").unwrap();
    assert!(is_same_file(&at("a"), &at("hard")) && is_same_file(&at("soft"), &at("hard")));
    assert!(!is_same_file(&at("a"), &at("b")) && !is_same_file(&at("absent"), &at("absent")));
}

#[test]
fn a_file_that_a_crash_has_left_is_listed_as_left_and_deleted_in_its_turn() {
    let temporary = tempfile::tempdir().unwrap();
    let options = Options { file: temporary.path().join("car.mcap"), keep_mb: 1, ..Options::default() };
    let options = Options { is_numbered: true, family: options.file.clone(), ..options };
    let age = |path: &Path, second: u64| {
        let time = SystemTime::UNIX_EPOCH + Duration::from_secs(second);
        File::options().write(true).open(path).unwrap().set_modified(time).unwrap();
    };
    let fill = |path: &Path, second: u64| {
        fs::write(path, vec![0; 400 << 10]).unwrap();
        age(path, second);
    };
    let mut crashed = Folder::open(&options).unwrap();
    drop(crashed.create(1).unwrap());
    fill(&crashed.path(1), 1);
    let mut writing = Folder::open(&options).unwrap();
    let being_written = writing.create(1).unwrap();
    fill(&writing.path(1), 0);
    let mut parts = Folder::open(&options).unwrap();
    let listed = |name: &str| {
        let part = parts_of_folder(&options).into_iter().find(|part| part.file.ends_with(name));
        part.map(|part| (part.is_unfinished, part.is_left))
    };
    assert_eq!(listed("car.unfinished.mcap"), Some((true, true)));
    assert_eq!(listed("car-1.unfinished.mcap"), Some((true, false)));
    for (part, second) in [(1, 2), (2, 3)] {
        drop(parts.create(part).unwrap());
        fill(&parts.path(part), second);
        parts.complete(part).unwrap();
        age(&parts.finished(part), second);
        parts.delete_old();
    }
    assert_eq!(listed("car.unfinished.mcap"), None, "the oldest that no recorder writes");
    assert_eq!(listed("car-1.unfinished.mcap"), Some((true, false)), "never while it is written");
    assert_eq!(listed("car-2.part-0002.mcap"), Some((false, false)), "the newest is never deleted");
    drop(being_written);
}

fn parts_of_folder(options: &Options) -> Vec<v1::RecordedPart> {
    Folder::of(options).list()
}

#[test]
fn a_folder_that_does_not_exist_is_created_and_named_once_in_the_log() {
    let temporary = tempfile::tempdir().unwrap();
    let file = temporary.path().join("drives/car.mcap");
    let log = temporary.path().join("log");
    let lines = File::create(&log).unwrap();
    let subscriber = tracing_subscriber::fmt().with_ansi(false).with_writer(lines).finish();
    tracing::subscriber::with_default(subscriber, || {
        folder(&file, false).unwrap();
        folder(&file, false).unwrap();
    });
    let said = fs::read_to_string(&log).unwrap();
    let named = format!("folder={}", temporary.path().join("drives").display());
    assert!(said.matches(&named).count() == 1 && said.contains("INFO"), "{said}");
}
