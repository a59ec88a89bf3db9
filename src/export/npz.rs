//! Arrays of NumPy: a ZIP archive with one `.npy` file for each, nothing compressed.

use std::borrow::Cow;
use std::io::{self, Write};

use crate::log::columns::Values;

/// Bytes to which the head of an array is filled up.
const ALIGNED: usize = 64;

/// Writes arrays under their names; each has a sample a row.
pub(super) fn write(arrays: &[(Cow<'static, str>, Values)], mut out: impl Write) -> io::Result<()> {
    let mut directory = Vec::new();
    let mut at = 0_u64;
    for (name, values) in arrays {
        let array = npy(values);
        let name = format!("{name}.npy");
        let too_large = "more than 4 GiB of arrays: write .parquet, or choose --channels";
        let [size, begin] = [array.len() as u64, at].map(u32::try_from);
        let (Ok(size), Ok(begin)) = (size, begin) else { return Err(io::Error::other(too_large)) };
        // Of both heads of a file: version 2.0, no flags, stored, 1980-01-01 00:00, checksum, sizes, length of the name.
        let mut head = Vec::new();
        for word in [20_u16, 0, 0, 0, 0x21] {
            head.extend(word.to_le_bytes());
        }
        for word in [crc32fast::hash(&array), size, size] {
            head.extend(word.to_le_bytes());
        }
        head.extend((name.len() as u16).to_le_bytes());
        // No further fields.
        head.extend([0; 2]);
        let mut file = b"PK\x03\x04".to_vec();
        file.extend(&head);
        file.extend(name.as_bytes());
        out.write_all(&file)?;
        out.write_all(&array)?;
        at += (file.len() + array.len()) as u64;
        directory.extend(b"PK\x01\x02\x14\x00");
        directory.extend(&head);
        // No comment, on the first disk, no attributes.
        directory.extend([0; 10]);
        directory.extend(begin.to_le_bytes());
        directory.extend(name.as_bytes());
    }
    let count = (arrays.len() as u16).to_le_bytes();
    let mut end = b"PK\x05\x06\0\0\0\0".to_vec();
    end.extend(count);
    end.extend(count);
    end.extend((directory.len() as u32).to_le_bytes());
    end.extend((at as u32).to_le_bytes());
    end.extend([0; 2]);
    out.write_all(&directory)?;
    out.write_all(&end)?;
    out.flush()
}

/// Returns an array in NumPy's format, version 1.0.
fn npy(values: &Values) -> Vec<u8> {
    let numbers = |rows: usize, shape: &[usize]| {
        let sizes = std::iter::once(&rows).chain(shape).map(|size| format!("{size},"));
        sizes.collect::<String>()
    };
    let (kind, shape, data): (Cow<'_, str>, String, Vec<u8>) = match values {
        Values::Numbers { shape, values } => {
            let each = shape.iter().product::<usize>().max(1);
            let data = values.iter().flat_map(|x| x.to_le_bytes()).collect();
            ("<f8".into(), numbers(values.len() / each, shape), data)
        }
        Values::Counts(counts) => {
            let data = counts.iter().flat_map(|x| x.to_le_bytes()).collect();
            ("<u8".into(), numbers(counts.len(), &[]), data)
        }
        Values::Words(words) => {
            let longest = words.iter().map(|word| word.chars().count()).max().unwrap_or(0).max(1);
            let padded = |word: &Cow<'_, str>| {
                let letters = word.chars().map(u32::from).chain(std::iter::repeat(0)).take(longest);
                letters.flat_map(u32::to_le_bytes).collect::<Vec<_>>()
            };
            (
                format!("<U{longest}").into(),
                numbers(words.len(), &[]),
                words.iter().flat_map(padded).collect(),
            )
        }
    };
    let mut head =
        format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({shape}), }}").into_bytes();
    const BEFORE: usize = 10;
    let whole = (BEFORE + head.len() + 1).next_multiple_of(ALIGNED);
    head.resize(whole - BEFORE - 1, b' ');
    head.push(b'\n');
    let mut array = b"\x93NUMPY\x01\x00".to_vec();
    array.extend((head.len() as u16).to_le_bytes());
    array.extend(head);
    array.extend(data);
    array
}
