//! A path -> an open file, or an error that says what is wrong with the file, and what to do.

use std::fs::File;
use std::io::{Error, ErrorKind, Read};
use std::path::Path;

/// Longest file of a configuration, a certificate or a calibration, in bytes. Ours: a thousand vehicles have 2 MB.
const TEXT_BYTES_MAX: u64 = 16 << 20;

/// Opens a file that is read more than once. A pipe or a device is refused, before its opening can wait for a writer.
///
/// # Errors
/// The system's error; [`ErrorKind::InvalidInput`] for a pipe, a socket or a device.
pub fn open_to_read(file: &Path) -> Result<File, Error> {
    let metadata = file.metadata()?;
    if !metadata.is_file() && !metadata.is_dir() {
        let advice = "this is a pipe or a device, and it may be read more than once; save it to a file first";
        return Err(Error::new(ErrorKind::InvalidInput, advice));
    }
    File::open(file)
}

/// The text of a file of a few kilobytes, such as a configuration: a server that runs reads it again, and must neither
/// wait for a pipe nor use much memory.
///
/// # Errors
/// As [`open_to_read`]; [`ErrorKind::FileTooLarge`] for more than 16 MiB; [`ErrorKind::InvalidData`] if it is no UTF-8.
pub fn read_text(file: &Path) -> Result<String, Error> {
    let mut text = String::new();
    open_to_read(file)?.take(TEXT_BYTES_MAX + 1).read_to_string(&mut text)?;
    match text.len() as u64 > TEXT_BYTES_MAX {
        true => Err(Error::new(ErrorKind::FileTooLarge, "it has more than 16 MiB; less is allowed")),
        false => Ok(text),
    }
}

/// The error of `file`, which could not be read or created, with a text that says what is wrong and what to do. The
/// text does not name the file, because the caller does.
pub fn advised(file: &Path, error: Error) -> Error {
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty());
    let kind = error.kind();
    let advice = match kind {
        // It has a text of ours.
        _ if error.get_ref().is_some() => return error,
        ErrorKind::NotFound => match folder.filter(|folder| !folder.exists()) {
            Some(folder) => format!("No such file: the folder {} does not exist", folder.display()),
            None => "No such file".to_owned(),
        },
        ErrorKind::PermissionDenied => "permission denied; check its owner and its mode".into(),
        _ if file.is_dir() => "this is a folder; name a file".into(),
        ErrorKind::InvalidData => "this is no text file (UTF-8); name one, not a recording or a picture".into(),
        ErrorKind::AlreadyExists if file.symlink_metadata().is_ok() => {
            "the file exists and is not overwritten; delete it, or name another file".into()
        }
        ErrorKind::AlreadyExists | ErrorKind::NotADirectory => {
            "a part of this path is a file, where a folder is needed".into()
        }
        _ => return error,
    };
    Error::new(kind, advice)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn each_error_of_the_system_becomes_an_advice() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::write(at("there"), "").unwrap();
        let advice = |file: &Path, result: std::io::Result<()>| advised(file, result.unwrap_err()).to_string();
        let read = |file: &Path| advice(file, fs::read(file).map(drop));
        assert_eq!(read(&at("absent")), "No such file");
        assert!(read(&at("no/absent")).contains("the folder") && read(&at("no/absent")).contains("does not exist"));
        assert_eq!(read(folder.path()), "this is a folder; name a file");
        assert!(read(&at("there/in")).contains("where a folder is needed"));
        fs::write(at("long"), vec![b'#'; TEXT_BYTES_MAX as usize + 1]).unwrap();
        let long = advice(&at("long"), read_text(&at("long")).map(drop));
        assert_eq!(long, "it has more than 16 MiB; less is allowed");
        fs::write(at("picture"), b"\x89PNG").unwrap();
        assert!(advice(&at("picture"), read_text(&at("picture")).map(drop)).starts_with("this is no text file"));
        assert!(advice(Path::new("/dev/zero"), read_text(Path::new("/dev/zero")).map(drop)).contains("a device"));
        let exists = advice(&at("there"), File::create_new(at("there")).map(drop));
        assert_eq!(exists, "the file exists and is not overwritten; delete it, or name another file");
    }
}
