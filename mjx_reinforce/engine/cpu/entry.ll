; What XLA calls, and how it calls @execute(ptr %frame), which returns an error or null.

; What XLA calls, when the handler is registered (it then asks for the version) and to execute.
define ptr @handler(ptr %frame) {
entry:
  %extension.at = getelementptr i8, ptr %frame, i64 $XLA_FFI_CallFrame_extension_start
  %extension = load ptr, ptr %extension.at
  %plain = icmp eq ptr %extension, null
  br i1 %plain, label %execute, label %extended
extended:
  %type.at = getelementptr i8, ptr %extension, i64 $XLA_FFI_Metadata_Extension_extension_base_type
  %type = load i32, ptr %type.at
  %asked = icmp eq i32 %type, 1
  br i1 %asked, label %metadata, label %execute
metadata:
  call void @tell_version(ptr %frame, ptr %extension)
  ret ptr null
execute:
  %error = call ptr @execute(ptr %frame)
  ret ptr %error
}

; Says: major version 0, and its minor version that XLA speaks, for they only add to each other.
define internal void @tell_version(ptr %frame, ptr %extension) {
  %metadata.at = getelementptr i8, ptr %extension, i64 $XLA_FFI_Metadata_Extension_metadata
  %metadata = load ptr, ptr %metadata.at
  %api.at = getelementptr i8, ptr %frame, i64 $XLA_FFI_CallFrame_api
  %api = load ptr, ptr %api.at
  %minor.at = getelementptr i8, ptr %api, i64 $XLA_FFI_Api_api_version_minor_version
  %minor = load i32, ptr %minor.at
  %major.to = getelementptr i8, ptr %metadata, i64 $XLA_FFI_Metadata_api_version_major_version
  store i32 0, ptr %major.to
  %minor.to = getelementptr i8, ptr %metadata, i64 $XLA_FFI_Metadata_api_version_minor_version
  store i32 %minor, ptr %minor.to
  %traits.to = getelementptr i8, ptr %metadata, i64 $XLA_FFI_Metadata_traits
  store i32 0, ptr %traits.to
  ret void
}

; Reads the data pointers of a list of XLA_FFI_Buffers.
define internal void @read_data(ptr %buffers, i64 %number, ptr %to) {
entry:
  br label %buffer
buffer:
  %i = phi i64 [0, %entry], [%i.next, %buffer]
  %buffer.at = getelementptr ptr, ptr %buffers, i64 %i
  %buffer.i = load ptr, ptr %buffer.at
  %data.at = getelementptr i8, ptr %buffer.i, i64 $XLA_FFI_Buffer_data
  %data = load ptr, ptr %data.at
  %to.at = getelementptr ptr, ptr %to, i64 %i
  store ptr %data, ptr %to.at
  %i.next = add i64 %i, 1
  %last = icmp eq i64 %i.next, %number
  br i1 %last, label %done, label %buffer
done:
  ret void
}

; XLA's error, an internal one (13), of a text.
define internal ptr @error(ptr %api, ptr %text) {
  %creating = alloca [4 x i64]
  store i64 28, ptr %creating
  %creating.extension = getelementptr i64, ptr %creating, i64 1
  store ptr null, ptr %creating.extension
  %creating.text = getelementptr i64, ptr %creating, i64 2
  store ptr %text, ptr %creating.text
  %creating.code = getelementptr i64, ptr %creating, i64 3
  store i32 13, ptr %creating.code
  %create.at = getelementptr i8, ptr %api, i64 $XLA_FFI_Api_XLA_FFI_Error_Create
  %create = load ptr, ptr %create.at
  %error = call ptr %create(ptr %creating)
  ret ptr %error
}
