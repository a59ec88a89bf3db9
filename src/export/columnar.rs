//! Columnar tables: Parquet and Arrow.

use std::io::{self, Write};
use std::sync::Arc;

use arrow_array::{ArrayRef, Float64Array, RecordBatch, StringArray, UInt64Array};
use arrow_ipc::writer::FileWriter;
use arrow_schema::{DataType, Field, Schema, SchemaRef};
use parquet::arrow::ArrowWriter;
use parquet::basic::{Compression, ZstdLevel};
use parquet::file::properties::WriterProperties;

use super::{Cell, Kind, Table};

/// Rows that are written at once.
const BATCH: usize = 1 << 13;

/// Takes batches of rows.
trait Batches {
    fn put(&mut self, batch: &RecordBatch) -> io::Result<()>;
    fn finish(self: Box<Self>) -> io::Result<()>;
}

impl<W: Write + Send> Batches for ArrowWriter<W> {
    fn put(&mut self, batch: &RecordBatch) -> io::Result<()> {
        self.write(batch).map_err(io::Error::other)
    }

    fn finish(mut self: Box<Self>) -> io::Result<()> {
        ArrowWriter::finish(&mut self).map(drop).map_err(io::Error::other)
    }
}

impl<W: Write> Batches for FileWriter<W> {
    fn put(&mut self, batch: &RecordBatch) -> io::Result<()> {
        self.write(batch).map_err(io::Error::other)
    }

    fn finish(mut self: Box<Self>) -> io::Result<()> {
        FileWriter::finish(&mut self).map_err(io::Error::other)?;
        self.get_mut().flush()
    }
}

/// Rows that wait to form a batch.
struct Waiting<'a> {
    schema: SchemaRef,
    kinds: Vec<Kind>,
    rows: Vec<Vec<Option<Cell>>>,
    out: Box<dyn Batches + 'a>,
}

/// Returns a table that is written as Parquet.
pub(super) fn parquet<'a>(
    names: &[String],
    kinds: &[Kind],
    out: impl Write + Send + 'a,
) -> io::Result<Box<dyn Table + 'a>> {
    let schema = schema(names, kinds);
    let properties = WriterProperties::builder()
        .set_compression(Compression::ZSTD(ZstdLevel::default()))
        // Digits of doubles hardly repeat.
        .set_dictionary_enabled(false)
        .build();
    let writer = ArrowWriter::try_new(out, schema.clone(), Some(properties));
    let out = Box::new(writer.map_err(io::Error::other)?);
    Ok(Box::new(Waiting { schema, kinds: kinds.to_vec(), rows: Vec::new(), out }))
}

/// Returns a table that is written as a file of Arrow.
pub(super) fn arrow<'a>(
    names: &[String],
    kinds: &[Kind],
    out: impl Write + Send + 'a,
) -> io::Result<Box<dyn Table + 'a>> {
    let schema = schema(names, kinds);
    let writer = FileWriter::try_new(io::BufWriter::new(out), &schema);
    let out = Box::new(writer.map_err(io::Error::other)?);
    Ok(Box::new(Waiting { schema, kinds: kinds.to_vec(), rows: Vec::new(), out }))
}

fn schema(names: &[String], kinds: &[Kind]) -> SchemaRef {
    let field = |(name, kind): (&String, &Kind)| {
        let kind = match kind {
            Kind::Number => DataType::Float64,
            Kind::Count => DataType::UInt64,
            Kind::Word => DataType::Utf8,
        };
        Field::new(name, kind, true)
    };
    Arc::new(Schema::new(names.iter().zip(kinds).map(field).collect::<Vec<_>>()))
}

impl Waiting<'_> {
    fn write(&mut self) -> io::Result<()> {
        let rows = std::mem::take(&mut self.rows);
        let column = |(at, kind): (usize, &Kind)| -> ArrayRef {
            match kind {
                Kind::Number => {
                    Arc::new(Float64Array::from_iter(rows.iter().map(|row| match row[at] {
                        Some(Cell::Number(value)) => Some(value),
                        _ => None,
                    })))
                }
                Kind::Count => {
                    Arc::new(UInt64Array::from_iter(rows.iter().map(|row| match row[at] {
                        Some(Cell::Count(value)) => Some(value),
                        _ => None,
                    })))
                }
                Kind::Word => {
                    Arc::new(StringArray::from_iter(rows.iter().map(|row| match &row[at] {
                        Some(Cell::Word(value)) => Some(value.as_str()),
                        _ => None,
                    })))
                }
            }
        };
        let columns = self.kinds.iter().enumerate().map(column).collect();
        let batch = RecordBatch::try_new(self.schema.clone(), columns);
        self.out.put(&batch.map_err(io::Error::other)?)
    }
}

impl Table for Waiting<'_> {
    fn put(&mut self, row: Vec<Option<Cell>>) -> io::Result<()> {
        self.rows.push(row);
        if self.rows.len() == BATCH { self.write() } else { Ok(()) }
    }

    fn finish(mut self: Box<Self>) -> io::Result<()> {
        if !self.rows.is_empty() {
            self.write()?;
        }
        self.out.finish()
    }
}
