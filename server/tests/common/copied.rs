//! A recording with other messages: for the tests of `verify`.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use mcap::records::Record;

/// Copies a recording, passing the topic, the sequence and the bytes of each message through `change`; `None` leaves
/// the message out.
pub fn copy(from: &Path, to: &Path, mut change: impl FnMut(&str, u32, Vec<u8>) -> Option<Vec<u8>>) {
    let bytes = std::fs::read(from).unwrap();
    let mut writer = mcap::Writer::new(BufWriter::new(File::create(to).unwrap())).unwrap();
    for record in mcap::read::LinearReader::new(&bytes).unwrap() {
        match record.unwrap() {
            Record::Metadata(metadata) => writer.write_metadata(&metadata).unwrap(),
            Record::Attachment { header, data, .. } => {
                let mcap::records::AttachmentHeader { log_time, create_time, name, media_type } = header;
                writer.attach(&mcap::Attachment { log_time, create_time, name, media_type, data }).unwrap();
            }
            _ => {}
        }
    }
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let mut message = message.unwrap();
        let topic = message.channel.topic.clone();
        if let Some(data) = change(&topic, message.sequence, message.data.into_owned()) {
            message.data = data.into();
            writer.write(&message).unwrap();
        }
    }
    writer.finish().unwrap();
}
